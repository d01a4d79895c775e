"""The health report in words: what stands out, and what to do about it.

Counts alone do not help who sees them for the first time. Each finding names what was seen, in
numbers, and the next thing to try; `stario live` shows the same words while a walk goes on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from stario.fusion.state import Health

Level = Literal["good", "note", "warning"]
"""Nothing to do; good to know; worth acting on."""

DROPPED_SHARE = 0.01
"""Samples dropped beyond this share are worth acting on."""

FLAGGED_SHARE = 1e-3
"""So are spikes and saturated samples beyond this one."""

GATED_SHARE = 0.1
"""And updates that the filter took for outliers beyond this one."""

NIS_RATIO = 2.0
"""Mean NIS this many times its expectation, or less than it by this factor, is worth saying."""

YAW_SIGMA = math.radians(15.0)
"""A direction known less well than this [rad] bends the track."""

LONG_GAP = 1.0
"""Behind a gap of this length [s] the direction is not known any more."""


@dataclass(frozen=True)
class Finding:
    """One thing that stands out.

    Attributes:
        level: whether something should be done.
        text: what was seen.
        advice: what to do; empty where there is nothing to do.
    """

    level: Level
    text: str
    advice: str = ""


def findings(health: Health) -> list[Finding]:
    """What stands out in a run so far, warnings first; never empty."""
    if _is_shaken(health):
        reasons = [_shaken(health), *_samples(health), *_gaps(health)]
        notes = [note for note in health.notes if not _is_unfamiliar(note)]
    else:
        reasons = [*_samples(health), *_flagged(health), *_gaps(health), *_updates(health)]
        notes = health.notes
    found = [*reasons, *_fixes(health), *_direction(health), *map(_noted, notes)]
    if not health.notes and not any(finding.level == "warning" for finding in found):
        found.insert(0, Finding("good", "Sensors, filter and network agree; nothing to do."))
    order: dict[str, int] = {"warning": 0, "good": 1, "note": 2}
    return sorted(found, key=lambda finding: order[finding.level])


def told(health: Health) -> list[str]:
    """The findings as lines of text, one each; those to act on begin with "!"."""
    return [
        f"{'! ' if finding.level == 'warning' else '  '}{finding.text} {finding.advice}".rstrip()
        for finding in findings(health)
    ]


def _is_shaken(health: Health) -> bool:
    """Whether sensor, weights and filter all disagree: then it is the data, and none of them."""
    return (
        _has_flagged(health)
        and any(map(_is_unfamiliar, health.notes))
        and health.gated > GATED_SHARE * health.updates
    )


def _shaken(health: Health) -> Finding:
    text = (
        "This track is not to be trusted: the device was shaken or struck, not carried ("
        f"{_counted(health.flagged)} samples, most of the motion is unlike a person's, and "
        f"{health.gated / health.updates:.0%} of the network's displacements did not fit the IMU)."
    )
    return Finding("warning", text, "Record a walk with the device held or strapped firmly.")


def _is_unfamiliar(note: str) -> bool:
    return "weights were trained on" in note


def _is_set_back(note: str) -> bool:
    return "clock was set back" in note


def _noted(note: str) -> Finding:
    text = f"{note[:1].upper()}{note[1:]}."
    if _is_set_back(note):
        return Finding("warning", text, "Split the recording there, and run each part.")
    if not _is_unfamiliar(note):
        return Finding("note", text)
    advice = "Fine-tune the weights on recordings of this kind: `stario train --start-from`."
    return Finding("warning", text, advice)


def _samples(health: Health) -> list[Finding]:
    used = health.samples.get("used", 0)
    dropped = {name: n for name, n in health.samples.items() if name != "used" and n}
    if any(map(_is_set_back, health.notes)):
        dropped.pop("out_of_order", None)  # that is why
    gone = sum(dropped.values())
    share = gone / max(1, used + gone)
    found = []
    if dropped:
        reasons = _counted(dropped)
        advice = "Log gyroscope and accelerometer at one rate, and close other apps."
        bad = share > DROPPED_SHARE
        amount = f"{share:.1%}" if share >= 0.001 else "Fewer than 0.1%"
        text = f"{amount} of the samples were dropped ({reasons})."
        found.append(Finding("warning" if bad else "note", text, advice if bad else ""))
    return found


def _has_flagged(health: Health) -> bool:
    return sum(health.flagged.values()) > FLAGGED_SHARE * max(1, health.samples.get("used", 0))


def _flagged(health: Health) -> list[Finding]:
    if not _has_flagged(health):
        return []
    text = f"Samples that no motion explains: {_counted(health.flagged)}."
    advice = "Hold or strap the device more firmly, or choose a larger range of the sensor."
    return [Finding("warning", text, advice)]


def _gaps(health: Health) -> list[Finding]:
    if not health.gap_count:
        return []
    several = f"{health.gap_count} gaps" if health.gap_count > 1 else "A gap"
    text = f"{several} in the samples, the longest of {health.longest_gap:.2f} s."
    if health.longest_gap < LONG_GAP:
        return [Finding("note", text)]
    advice = (
        "Keep the logger in the foreground and exempt it from battery saving; "
        "a fix of position or yaw behind the gap brings the direction back."
    )
    return [Finding("warning", text, advice)]


def _updates(health: Health) -> list[Finding]:
    found = []
    if health.updates:
        gated = health.gated / health.updates
        if gated > GATED_SHARE:
            text = f"{gated:.0%} of the network's displacements did not fit the IMU."
            advice = (
                "The motion may be unlike what the weights learned (carrying, running, wheels): "
                "fine-tune them on recordings of this kind with `stario train`."
            )
            found.append(Finding("warning", text, advice))
    ratio = health.mean_nis / health.nis_expected
    if ratio > NIS_RATIO:
        text = f"Innovations are larger than expected (mean NIS {health.mean_nis:.1f})."
        advice = "Read the sigmas as too small by about this ratio's root; recalibrate the weights."
        found.append(Finding("warning", text, f"{advice} Ratio: {ratio:.1f}."))
    elif ratio < 1.0 / NIS_RATIO:
        text = f"Innovations are smaller than expected (mean NIS {health.mean_nis:.1f})."
        advice = "Single ones say little of a track's sigmas: errors that last make small ones."
        found.append(Finding("note", text, advice))
    bearings = sum(n for name, n in health.bearings.items() if name != "gated")
    useless = bearings - health.bearings.get("applied", 0)
    if useless > 0.5 * bearings:
        text = f"The magnetic field was of little use ({_counted(health.bearings)})."
        advice = "`stario inspect` tells its size, unit and what is wrong with it."
        found.append(Finding("note", text, advice))
    left_out = _counted(health.refused)
    if left_out:
        found.append(Finding("note", f"Displacements left out: {left_out}."))
    return found


def _fixes(health: Health) -> list[Finding]:
    if not health.fixes:
        return []
    applied = health.fixes.get("applied", 0)
    other = {name: n for name, n in health.fixes.items() if name != "applied" and n}
    text = "1 fix applied" if applied == 1 else f"{applied} fixes applied"
    if not other:
        return [Finding("note", f"{text}.")]
    reasons = _counted(other)
    early = ("gated", "waiting", "yaw not known")
    refused = sum(n for name, n in other.items() if name not in early)
    wrong = refused or other.get("gated", 0) > GATED_SHARE * applied
    advice = "Check the fixes' clock, frame, units and sigmas." if wrong else ""
    if not wrong and other.get("yaw not known", 0) > applied:
        advice = "Positions tell the direction once one has walked some metres; a yaw tells it too."
    return [Finding("warning" if wrong else "note", f"{text}; {reasons}.", advice)]


def _direction(health: Health) -> list[Finding]:
    yaw = health.final_sigma.get("yaw_rad", 0.0)
    if yaw <= YAW_SIGMA:
        return []
    text = f"The direction is known to {math.degrees(yaw):.0f} degrees only (1 sigma)."
    advice = "Rest for two seconds now and then, or give a fix of yaw or two of position."
    return [Finding("warning", text, advice)]


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in counts.items() if n)
