"""The health report in words: what stands out, and what to do about it.

Counts alone do not help a first-time user. Each finding states what was observed, in numbers, and
the next thing to try; `stario live` shows the same text during a walk.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from stario.fusion.health import Health
from stario.fusion.imu.front_end import BRIDGED
from stario.fusion.imu.gap import INTERPOLATED
from stario.sequences.attitude.levelling import START_SECONDS

Level = Literal["good", "note", "warning"]
"""Severity: nothing to do, good to know, or worth acting on."""

DROPPED_SHARE = 0.01
"""Share of dropped samples above which to warn."""

FLAGGED_SHARE = 1e-3
"""Share of spikes and saturated samples above which to warn."""

GATED_SHARE = 0.1
"""Share of updates treated as outliers above which to warn."""

MIN_UPDATES = 20
"""Number of the network's displacements below which nothing is said about network and motion: ten
seconds of them."""

_RESTING = 100
"""Number of zero-velocity updates that are as good: ten seconds of rest."""

NIS_RATIO = 2.0
"""Factor between mean NIS and expectation, in either direction, above which to report it."""

YAW_SIGMA = math.radians(15.0)
"""Standard deviation of yaw [rad] above which the track bends."""

LOST_YAW_SIGMA = 1.5
"""Yaw sigma beyond which the yaw is unknown [rad], not drifted: standing still does not help."""

_APART = "at least six times their sigma apart"
"""How far apart two positions determine the direction (`filter.map_frame.MAX_POSITION_YAW_SIGMA`):
the root of two over that sigma, and some more for the drift between them."""


@dataclass(frozen=True)
class Finding:
    """One observation that stands out.

    Attributes:
        level: severity.
        text: what was observed.
        advice: what to do; empty if nothing.
    """

    level: Level
    text: str
    advice: str = ""


def findings(health: Health) -> list[Finding]:
    """Return what stands out in a run so far, warnings first; never empty."""
    early = health.updates < MIN_UPDATES
    notes = health.notes
    if early or _is_invalid(health):
        notes = [note for note in notes if not _is_unfamiliar(note)]
    if not early and _is_invalid(health):
        reasons = [_invalid_data(health), *_samples(health), *_gaps(health)]
    else:
        reasons = [*_samples(health), *_flagged(health), *_gaps(health)]
        reasons += [*([] if early else _updates(health)), *_corrections(health), *_field(health)]
    found = [*reasons, *_fixes(health), *_direction(health), *map(_noted, notes)]
    if early and health.zero_velocity.get("applied", 0) < _RESTING:
        found.append(Finding("note", "Too early to judge the motion: it takes ten seconds of it."))
    elif not notes and not any(finding.level == "warning" for finding in found):
        found.insert(0, Finding("good", "Sensors, filter and network agree; nothing to do."))
    order = ("warning", "good", "note")
    return sorted(found, key=lambda finding: order.index(finding.level))


def health_lines(health: Health) -> list[str]:
    """Return one line of text per finding; those to act on begin with "!"."""
    return [
        f"{'! ' if finding.level == 'warning' else '  '}{finding.text} {finding.advice}".rstrip()
        for finding in findings(health)
    ]


def _is_invalid(health: Health) -> bool:
    """Return whether sensor, weights and filter all disagree: then the data are at fault."""
    return (
        _has_flagged(health)
        and any(map(_is_unfamiliar, health.notes))
        and health.gated > GATED_SHARE * health.updates
    )


def _invalid_data(health: Health) -> Finding:
    text = (
        "This track cannot be trusted: the device was shaken or struck, not carried ("
        f"{_counted(health.flagged)} samples; most of the motion is unlike a pedestrian's; "
        f"{health.gated / health.updates:.0%} of the network's displacements contradict the IMU)."
    )
    return Finding("warning", text, "Record a walk with the device held or strapped firmly.")


def _is_unfamiliar(note: str) -> bool:
    return "weights were trained on" in note


def _is_set_back(note: str) -> bool:
    return "clock was set back" in note


def _is_stopped(note: str) -> bool:
    return " stopped: it repeats" in note


def _noted(note: str) -> Finding:
    text = f"{note[:1].upper()}{note[1:]}."
    if _is_set_back(note):
        return Finding("warning", text, "Split the recording there and run each part separately.")
    if _is_stopped(note):
        advice = (
            "Restart the device and record again; if it recurs, the sensor or the app is faulty."
        )
        return Finding("warning", text, advice)
    if not _is_unfamiliar(note):
        return Finding("note", text)
    advice = "Fine-tune the weights on recordings of this kind: `stario train --start-from`."
    return Finding("warning", text, advice)


def _samples(health: Health) -> Iterator[Finding]:
    used = health.samples.get("used", 0)
    dropped = {name: n for name, n in health.samples.items() if name != "used" and n}
    if any(map(_is_set_back, health.notes)):
        dropped.pop("out_of_order", None)  # explained by that note
    if any(map(_is_stopped, health.notes)):
        dropped.pop("frozen", None)
    count = sum(dropped.values())
    share = count / max(1, used + count)
    amount = f"{share:.1%}" if share >= 0.001 else "Fewer than 0.1%"
    text = f"{amount} of the samples were dropped ({_counted(dropped)})."
    if share > DROPPED_SHARE:
        advice = "Log gyroscope and accelerometer at the same rate, and close other apps."
        if dropped.get("frozen", 0) > 0.5 * count:  # both sensors: of one alone there is a note
            advice = (
                "The sensors repeat their values: log them at their own rate; if they stopped for "
                "good, restart the device and record again."
            )
        elif dropped.get("out_of_order", 0) > 0.5 * count:
            advice = "`stario inspect` says when: sort the rows, or split the recording there."
        yield Finding("warning", text, advice)
    elif dropped:
        yield Finding("note", text)


def _has_flagged(health: Health) -> bool:
    return sum(health.flagged.values()) > FLAGGED_SHARE * max(1, health.samples.get("used", 0))


def _flagged(health: Health) -> Iterator[Finding]:
    if _has_flagged(health):
        text = f"Samples that motion cannot explain: {_counted(health.flagged)}."
        advice = "Hold or strap the device more firmly, or choose a larger sensor range."
        yield Finding("warning", text, advice)


def _gaps(health: Health) -> Iterator[Finding]:
    if not health.gap_count:
        return
    amount = f"{health.gap_count} gaps" if health.gap_count > 1 else "1 gap"
    text = f"{amount} in the samples (longest: {health.longest_gap:.2f} s)."
    logger = "Keep the logger in the foreground and exempt it from battery saving"
    if health.longest_gap > INTERPOLATED:
        restore = "a yaw fix or position fixes after the gap restore the heading"
        yield Finding("warning", text, f"{logger}; {restore}.")
    else:
        yield Finding("note", text)
    gaps = [(start, length) for start, length in health.gaps if length > BRIDGED]
    between = [b - (a + length) for (a, length), (b, _) in pairwise(gaps)]
    if short := sum(seconds < START_SECONDS for seconds in between):
        text = (
            f"{short} of the stretches between gaps are shorter than a second, which does not "
            "suffice to level the attitude: the track leaves them out."
        )
        yield Finding("warning", text, f"{logger}; over Bluetooth, lower the rate.")


def _updates(health: Health) -> Iterator[Finding]:
    if health.gated > GATED_SHARE * health.updates:
        gated = health.gated / health.updates
        text = f"{gated:.0%} of the network's displacements contradict the IMU."
        advice = (
            "Check that both sensors have the same axes and signs (`stario inspect`). "
            "If so, the motion may differ from the training data (carrying, running, wheels): "
            "fine-tune the weights on recordings of this kind with `stario train`."
        )
        yield Finding("warning", text, advice)
    ratio = health.mean_nis / health.nis_expected
    nis = f"mean NIS {health.mean_nis:.2g}, expected {health.nis_expected:.0f}"
    if ratio > NIS_RATIO:
        text = f"The network and the IMU disagree by more than their sigmas allow ({nis})."
        advice = (
            f"The track's sigmas are too small by a factor of about {math.sqrt(ratio):.1f}: "
            "fine-tune the weights on recordings of this kind with `stario train --start-from`."
        )
        yield Finding("warning", text, advice)
    elif ratio < 1.0 / NIS_RATIO:
        text = (
            f"The network and the IMU agree more closely than their sigmas suggest ({nis}). It "
            "does not mean that the track's sigmas are too large: errors that last as long as the "
            "track do not show here."
        )
        yield Finding("note", text)


def _corrections(health: Health) -> Iterator[Finding]:
    if not health.corrections:
        return
    time, metres, turn, cause = max(health.corrections, key=lambda found: found[1])
    count = len(health.corrections)
    at_once = "Once the track was" if count == 1 else f"{count} times the track was"
    text = (
        f"{at_once} corrected by more than 1 m or 10 degrees (the largest by {metres:.1f} m and "
        f"{math.degrees(turn):.0f} degrees at {time:.1f} s: {cause})."
    )
    advice = "Until then a stream's track was wrong by as much; a recording's is smoothed."
    yield Finding("warning", text, advice)


def _field(health: Health) -> Iterator[Finding]:
    bearings = sum(n for name, n in health.bearings.items() if name != "gated")
    useless = bearings - health.bearings.get("applied", 0)
    if useless > 0.5 * bearings:
        text = f"The magnetic field was of little use ({_counted(health.bearings)})."
        advice = "`stario inspect` reports its magnitude, unit and problems."
        yield Finding("note", text, advice)
    if refused := _counted(health.refused):
        yield Finding("note", f"Displacements not used: {refused}.")


def _fixes(health: Health) -> Iterator[Finding]:
    if not health.fixes:
        return
    applied = health.fixes.get("applied", 0)
    other = {name: n for name, n in health.fixes.items() if name != "applied" and n}
    text = "1 fix applied" if applied == 1 else f"{applied} fixes applied"
    if not other:
        yield Finding("note", f"{text}.")
        return
    reasons = _counted(other)
    harmless = ("gated", "waiting", "yaw not known")
    refused = sum(n for name, n in other.items() if name not in harmless)
    wrong = refused or other.get("gated", 0) > GATED_SHARE * applied
    advice = "Check the fixes' clock, frame, units and sigmas." if wrong else ""
    if not wrong and other.get("yaw not known", 0) > applied:
        advice = f"Two positions {_APART} give the heading; so does a yaw fix."
    yield Finding("warning" if wrong else "note", f"{text}; {reasons}.", advice)


def _direction(health: Health) -> Iterator[Finding]:
    yaw = health.final_sigma.get("yaw_rad", 0.0)
    if yaw > YAW_SIGMA:
        text = f"The heading is known only to {math.degrees(yaw):.0f} degrees (1 sigma)."
        advice = f"A yaw fix or two position fixes {_APART} determine it."
        if health.longest_gap <= INTERPOLATED and yaw < LOST_YAW_SIGMA:
            advice = (
                "Keep still for two seconds now and then; a yaw fix or two position fixes "
                f"{_APART} help too."
            )
        yield Finding("warning", text, advice)


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)
