"""Findings of a run's health: what stands out in its counts, and what to do about it.

Counts alone do not help a first-time user. Each finding states what was observed, in numbers, and
the next thing to try. `stario.sequences.findings.verdict` joins them with those of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

from stario.fusion.filter.innovations import USUAL_LEVEL
from stario.fusion.imu.barometer import SILENT_SECONDS
from stario.fusion.imu.front_end import BRIDGED
from stario.fusion.imu.gap import INTERPOLATED
from stario.fusion.values.health import Health
from stario.sequences.attitude.levelling import START_SECONDS
from stario.sequences.findings import TOO_EARLY, Finding

DROPPED_SHARE, FLAGGED_SHARE = 0.01, 1e-3
"""Shares of dropped samples, and of spikes and saturated ones, above which to warn."""

GATED_SHARE, BEARINGS_SHARE = 0.1, 0.25
"""Shares of updates treated as outliers, and of the magnetic bearings that contradict the
gyroscope, above which to warn."""

MIN_UPDATES = 20
"""Number of the network's displacements, or of bearings, below which nothing is said about them:
ten seconds."""

_RESTING = 100
"""Number of zero-velocity updates that are as good: ten seconds of rest."""

NIS_RATIO = 2.0
"""Factor between mean NIS and expectation, in either direction, above which to report it."""

_LATE_S, _FIELDS_DROPPED = 0.5, 50
"""Late samples in a row [s], and dropped magnetic fields, beyond which to tell of them."""

TURNED_RAD = math.radians(45.0)
"""Turn of the network's direction, beyond three sigmas, that is reported [rad]: half of a quarter
turn, beyond which a track goes to another side rather than along its way."""

YAW_SIGMA = math.radians(15.0)
"""Standard deviation of yaw [rad] above which the track bends."""

LOST_YAW_SIGMA = 1.5
"""Yaw sigma beyond which the yaw is unknown [rad], not drifted: standing still does not help."""

_APART = "at least six times their sigma apart, as far as the track is long between them,"
"""How far apart two positions determine the direction (`filter.map_frame.MAX_POSITION_YAW_SIGMA`):
the root of two over that sigma, and some more for the drift between them."""

_CARRY = "carry the device as walkers usually do, or judge the track by known positions"


def health_findings(health: Health) -> list[Finding]:
    """Return what stands out in a run so far."""
    found = [*_clock(health), *_stopped(health), *_samples(health), *_gaps(health)]
    if health.updates >= MIN_UPDATES:
        found += [*_flagged(health), *_network(health)]
    elif health.zero_velocity.get("applied", 0) < _RESTING:
        text = "Too early to judge the motion: it takes ten seconds of it."
        found += [*_flagged(health), _found(TOO_EARLY, text)]
    found += [*_floors(health), *_corrections(health), *_field(health)]
    found += [*_fixes(health), *_jumps(health), *_rides(health), *_direction(health)]
    notes = (f"{note[:1].upper()}{note[1:]}." for note in health.notes)
    return found + [Finding(f"note_{k}", note) for k, note in enumerate(notes)]


def _found(
    code: str, text: str, advice: str = "", values: Mapping[str, object] | None = None
) -> Finding:
    """Return a finding: a warning if there is something to do, else a note."""
    return Finding(code, text, advice, "warning" if advice else "note", values or {})


def _clock(health: Health) -> Iterator[Finding]:
    late = health.longest_late
    if by := health.set_back:
        text = f"The recording's clock was set back by {by:.3g} s: the track ends there."
        advice = "Split the recording there and run each part separately."
        yield _found("clock_set_back", text, advice, {"by_s": by})
    elif late > _LATE_S:
        text = (
            f"Samples arrived late for {late:.1f} s in a row: logged twice, or from a clock that "
            "was set back; if so, that time is missing, and counts as a gap."
        )
        yield _found("samples_late", text, values={"longest_s": late})


def _stopped(health: Health) -> Iterator[Finding]:
    for sensor, count in health.stopped.items():
        text = (
            f"The {sensor} stopped: it repeats its value, or one axis does, in {count} samples in "
            "which the others show motion; they were dropped."
        )
        advice = (
            "Restart the device and record again; if it recurs, the sensor or the app is faulty."
        )
        yield _found(f"{sensor}_stopped", text, advice, {"samples": count})


def _samples(health: Health) -> Iterator[Finding]:
    used = health.samples.get("used", 0)
    dropped = {name: n for name, n in health.samples.items() if name != "used" and n}
    if health.set_back:
        dropped.pop("out_of_order", None)  # told already
    if health.stopped:
        dropped.pop("frozen", None)
    if not dropped:
        return
    count = sum(dropped.values())
    share = count / (used + count)
    amount = f"{share:.1%}" if share >= 0.001 else "Fewer than 0.1%"
    text = f"{amount} of the samples were dropped ({_counted(dropped)})."
    advice = "Log gyroscope and accelerometer at the same rate, and close other apps."
    if dropped.get("frozen", 0) > 0.5 * count:  # both sensors: of one alone it is told above
        advice = (
            "The sensors repeat their values: log them at their own rate; if they stopped for "
            "good, restart the device and record again."
        )
    elif dropped.get("out_of_order", 0) > 0.5 * count:
        advice = "`stario inspect` says when: sort the rows, or split the recording there."
    yield _found("samples_dropped", text, advice if share > DROPPED_SHARE else "", dropped)


def _flagged(health: Health) -> Iterator[Finding]:
    """Report samples beyond the sensors; a track that contradicts them as well is not trusted."""
    if sum(health.flagged.values()) <= FLAGGED_SHARE * max(1, health.samples.get("used", 0)):
        return
    counted = _counted(health.flagged)
    text = f"Samples that motion cannot explain: {counted}."
    advice = "Hold or strap the device more firmly, or choose a larger sensor range."
    if health.updates >= MIN_UPDATES and health.gated > GATED_SHARE * health.updates:
        text = (
            f"This track cannot be trusted: the device was shaken or struck beyond its sensors' "
            f"range ({counted} samples), and {health.gated / health.updates:.0%} of the network's "
            "displacements contradict the IMU."
        )
        advice = "Record a walk with the device held or strapped firmly."
    yield _found("samples_flagged", text, advice, health.flagged)


def _gaps(health: Health) -> Iterator[Finding]:
    if not health.gap_count:
        return
    amount = f"{health.gap_count} gaps" if health.gap_count > 1 else "1 gap"
    text = f"{amount} in the samples (longest: {health.longest_gap:.2f} s)."
    logger = "Keep the logger in the foreground and exempt it from battery saving"
    restore = f"{logger}; a yaw fix or position fixes after the gap restore the heading."
    values = {"count": health.gap_count, "longest_s": health.longest_gap}
    yield _found("gaps", text, restore if health.longest_gap > INTERPOLATED else "", values)
    gaps = [(start, length) for start, length in health.gaps if length > BRIDGED]
    between = [b - (a + length) for (a, length), (b, _) in pairwise(gaps)]
    if short := sum(seconds < START_SECONDS for seconds in between):
        text = (
            f"{short} of the stretches between gaps are shorter than a second, which does not "
            "suffice to level the attitude: the track leaves them out."
        )
        advice = f"{logger}; over Bluetooth, lower the rate."
        yield _found("short_stretches", text, advice, {"count": short})


def _network(health: Health) -> Iterator[Finding]:
    gated = health.gated / health.updates
    if gated > GATED_SHARE:
        text = f"{gated:.0%} of the network's displacements contradict the IMU."
        advice = (
            "If the sensors' axes and signs are right, the weights do not know this motion "
            f"(carrying, running, wheels): {_CARRY}."
        )
        yield _found("network_contradicts", text, advice, {"share": gated})
    ratio = health.mean_nis / health.nis_expected
    nis = f"mean NIS {health.mean_nis:.2g}, expected {health.nis_expected:.0f}"
    if health.network_error_level > NIS_RATIO * USUAL_LEVEL:
        times = math.sqrt(health.network_error_level)
        text = f"The network's errors are {times:.1f} times as large as it predicts."
        advice = f"The weights know neither this motion nor how wrong they are: {_CARRY}."
        yield _found("network_sigma", text, advice, {"sigmas": times})
    elif ratio > NIS_RATIO:
        text = f"The network and the IMU disagree by more than their sigmas allow ({nis})."
        advice = f"The track's sigmas are too small by a factor of about {math.sqrt(ratio):.1f}."
        yield _found("network_sigma", text, advice, {"nis_ratio": ratio})
    elif ratio < 1.0 / NIS_RATIO:
        text = (
            f"The network and the IMU agree more closely than their sigmas suggest ({nis}). It "
            "does not mean that the track's sigmas are too large: errors that last as long as the "
            "track do not show here."
        )
        yield _found("network_sigma", text, values={"nis_ratio": ratio})
    turn, sigma = health.network_turn, health.network_turn_sigma
    if abs(turn) > max(TURNED_RAD, 3.0 * sigma):
        degrees, spread = math.degrees(turn), math.degrees(sigma)
        text = (
            f"The network's direction differs from the accelerometer's by {degrees:.0f} "
            f"(+-{spread:.0f}) degrees: its track is turned by as much."
        )
        advice = f"The weights do not know this motion: {_CARRY}."
        values = {"turn_deg": degrees, "sigma_deg": spread}
        yield _found("network_direction", text, advice, values)


def _corrections(health: Health) -> Iterator[Finding]:
    if not health.corrections:
        return
    time, metres, turn, cause = max(health.corrections, key=lambda found: found[1])
    count, degrees = len(health.corrections), math.degrees(turn)
    at_once = "Once the track was" if count == 1 else f"{count} times the track was"
    text = (
        f"{at_once} corrected by more than 1 m or 10 degrees (the largest by {metres:.1f} m and "
        f"{degrees:.0f} degrees at {time:.1f} s: {cause})."
    )
    advice = (
        "If the track is wrong, look there first: a stream's was until then; a recording's is "
        "smoothed."
    )
    values = {"count": count, "largest_m": metres, "turn_deg": degrees, "at_s": time}
    yield _found("corrections", text, advice, values)


def _floors(health: Health) -> Iterator[Finding]:
    start, seconds = health.pressure_silence
    if seconds > SILENT_SECONDS:  # a lift may have passed a floor
        text = (
            f"The barometer told nothing for {seconds:.0f} s from {start:.0f} s on: there is no "
            "pressure, or the same one again and again."
        )
        advice = (
            "The height there is the network's, which knows no stairs: keep the logger in the "
            "foreground, or give fixes with heights."
        )
        yield _found("pressure_silent", text, advice, {"start_s": start, "seconds": seconds})
    if health.floors:
        ways = "; ".join(map(str, health.floors))
        floors = [change._asdict() for change in health.floors]
        yield _found("floors", f"{ways[0].upper()}{ways[1:]}.", values={"floors": floors})


def _field(health: Health) -> Iterator[Finding]:
    offered = sum(n for name, n in health.bearings.items() if name != "gated")
    against = health.bearings.get("contradicts the gyroscope", 0)
    if offered >= MIN_UPDATES and against > BEARINGS_SHARE * offered:
        text = (
            f"{against} of {offered} bearings of the magnetic field contradict the gyroscope and "
            "were not used."
        )
        advice = (
            "Iron, a current or the device disturbs the field: walk elsewhere, or calibrate it."
        )
        values = {"contradicting": against, "offered": offered}
        yield _found("bearings_contradict", text, advice, values)
    elif offered - health.bearings.get("applied", 0) > 0.5 * offered:
        text = f"The magnetic field was of little use ({_counted(health.bearings)})."
        yield _found("field_useless", text, values=health.bearings)
    if apart := health.north_contradiction:
        degrees = math.degrees(apart)
        text = (
            "Magnetic north and the direction by fixes or the known start contradict each other by "
            f"{degrees:.0f} degrees; the track keeps to the latter."
        )
        advice = (
            "Check both: a declination is positive to the east, a yaw is measured in the map from "
            "the x axis (east) towards the y axis (north)."
        )
        yield _found("north_contradicts", text, advice, {"degrees": degrees})
    if health.fields_dropped > _FIELDS_DROPPED:
        text = (
            f"{health.fields_dropped} magnetic fields were dropped: the sensor repeated its last "
            "value, or their times or values are wrong."
        )
        yield _found("fields_dropped", text, values={"count": health.fields_dropped})
    if refused := _counted(health.refused):
        text = f"Displacements not used: {refused}."
        yield _found("displacements_refused", text, values=health.refused)


def _fixes(health: Health) -> Iterator[Finding]:
    if not health.fixes:
        return
    applied = health.fixes.get("applied", 0)
    other = {name: n for name, n in health.fixes.items() if name != "applied" and n}
    harmless = ("gated", "waiting", "yaw not known")
    refused = sum(n for name, n in other.items() if name not in harmless)
    wrong = bool(refused or other.get("gated", 0) > GATED_SHARE * applied)
    advice = "Check the fixes' clock, frame, units and sigmas." if wrong else ""
    if not wrong and other.get("yaw not known", 0) > applied:
        advice = f"Two positions {_APART} give the heading; so does a yaw fix."
    text = "1 fix applied" if applied == 1 else f"{applied} fixes applied"
    if len(health.fix_kinds) > 1:
        kinds = ", ".join(f"{n} of {kind}" for kind, n in health.fix_kinds.items())
        text += f" (given: {kinds})"
    if gated := other.pop("gated", 0):
        text += f", {gated} of them with less weight, since the track contradicts them"
    text += f"; {_counted(other)}." if other else "."
    yield Finding("fixes", text, advice, "warning" if wrong else "note", health.fixes)


def _jumps(health: Health) -> Iterator[Finding]:
    if not health.jumps:
        return
    since, until, metres, carried = max(health.jumps, key=lambda jump: jump[2])
    count = len(health.jumps)
    times = "" if count == 1 else f"{count} times, the most "
    when = f"from {until:.0f} s on: the track was moved to them"
    if carried:
        when = (
            f"between {since:.0f} s and {until:.0f} s, as if a vehicle had carried the device: the "
            "track was moved to them, and the smoothed one leaves out the displacements in between"
        )
    text = f"Positions in a row contradict the track {times}by {metres:.0f} m {when}."
    advice = "If nothing carried the device there, check these positions."
    values = {"count": count, "since_s": since, "until_s": until, "metres": metres}
    values |= {"carried": carried}
    yield _found("jumps", text, advice, values)


def _rides(health: Health) -> Iterator[Finding]:
    if not health.rides:
        return
    spans = [f"between {since:.0f} s and {until:.0f} s" for since, until in health.rides]
    text = (
        f"{_listed(spans)} the device was accelerated as no walk does while the network saw it "
        "stand: in a vehicle? The track does not know that way; until a position tells it, its "
        "sigma allows for 15 m/s."
    )
    advice = "Give position fixes after it: they place the track again."
    yield _found("rides", text[0].upper() + text[1:], advice, {"rides": health.rides})


def _listed(words: Sequence[str], most: int = 3) -> str:
    rest = len(words) - most
    return ", ".join(words[:most]) + (f" and {rest} times more" if rest > 0 else "")


def _direction(health: Health) -> Iterator[Finding]:
    yaw = health.final_sigma.get("yaw_rad", 0.0)
    if yaw <= YAW_SIGMA:
        return
    lost = yaw >= LOST_YAW_SIGMA
    text = f"The heading is known only to {math.degrees(yaw):.0f} degrees (1 sigma)."
    advice = f"A yaw fix or two position fixes {_APART} determine it."
    if health.longest_gap <= INTERPOLATED and not lost:
        advice = (
            "Keep still for two seconds now and then; a yaw fix or two position fixes "
            f"{_APART} help too."
        )
    text = "The heading is lost." if lost else text
    yield _found("yaw_unknown", text, advice, {"sigma_deg": math.degrees(yaw)})


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)
