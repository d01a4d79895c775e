"""Inspection of a recording: its properties and problems, before anything is computed from it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from stario.sequences.arrays import check_type
from stario.sequences.clean_samples import cleaned, finite_samples, usable
from stario.sequences.errors import InputError
from stario.sequences.findings import Assessment, Finding, verdict
from stario.sequences.inspection.checks import unit_findings
from stario.sequences.inspection.magnetic import assess_magnetometer
from stario.sequences.inspection.outside_sensors import assess_barometer, assess_satellites
from stario.sequences.inspection.samples import (
    clock_findings,
    dead_axes,
    sample_findings,
    without_times_ahead,
)
from stario.sequences.inspection.stillness import Rest, find_rest
from stario.sequences.sequence import GAP_STEPS, STANDARD_GRAVITY, ImuSequence
from stario.sequences.truth.fit import TruthFit
from stario.sequences.truth.problems import assess_truth


@dataclass(frozen=True, eq=False)
class Inspection:
    """What was found about a recording.

    Attributes:
        name: name of the recording.
        figures: what was measured, by name; units are in the names.
        findings: what stands out.
        fit: fit of truth and gyroscope; None if they cannot be compared.
        rest: sensor statistics at rest; None if the device never rests.
    """

    name: str
    figures: dict[str, Any]
    findings: tuple[Finding, ...]
    fit: TruthFit | None
    rest: Rest | None
    _lines: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """Return figures and verdict as plain values, with units in their names."""
        told = [asdict(finding) for finding in verdict(self.findings)]
        return {"recording": self.name, **self.figures, "verdict": told}

    def lines(self) -> list[str]:
        """Return the figures as lines to print."""
        return list(self._lines)


def inspect_recording(sequence: ImuSequence) -> Inspection:
    """Inspect a recording; what is wrong is returned, not raised.

    Raises:
        InputError: the recording holds no finite sample, or `sequence` has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    given, sequence = len(sequence), without_times_ahead(sequence)
    finite = finite_samples(sequence)
    if not finite.any():
        raise InputError(f"{sequence.name}: samples", "no finite sample", "numbers")
    valid = finite & usable(sequence) if (finite & usable(sequence)).any() else finite
    findings, refusal = sample_findings(sequence) + dead_axes(sequence), ""
    clean, rest, magnetic = sequence, None, None
    try:
        findings += unit_findings(sequence)
        clean = cleaned(sequence)  # once: it counts in a warning what it drops
    except InputError as error:
        field = error.field.removeprefix(f"{sequence.name}: ")
        text = f"{field}: found {error.found}, expected {error.expected}"
        findings.append(Finding("refused", text, error.fix))
        refusal = error.fix or text
    truth, fit = assess_truth(clean, refusal)
    with suppress(InputError):  # an invalid rate, which was reported
        rest, magnetic = find_rest(clean), assess_magnetometer(clean)
    sensors = {
        "magnetometer": magnetic,
        "barometer": assess_barometer(sequence.barometer),
        "satellites": assess_satellites(sequence.satellites),
    }
    known = [part for part in sensors.values() if part]
    for part in (truth, *known):
        findings += part.findings
    findings += clock_findings(sequence)
    timing = _timing(sequence, given, int((~finite).sum()))
    accel, gyro = (
        float(np.linalg.norm(values[valid], axis=1).mean())
        for values in (sequence.accel, sequence.gyro)
    )
    own = 0 if sequence.device_attitude is None else len(sequence.device_attitude)
    lines = [
        *timing.lines,
        f"accelerometer: {accel:.3f} m/s^2 on average; gyroscope: {gyro:.3f} rad/s",
        *_rest_lines(rest),
        *(line for part in known for line in part.lines),
        *([f"device's own attitudes: {own}"] if own else []),
        *truth.lines,
    ]
    figures = {
        **timing.figures,
        "accel_norm_mean_m_s2": accel,
        "gyro_norm_mean_rad_s": gyro,
        "rest": rest and {"seconds": rest.seconds, **vars(rest)},
        **truth.figures,
        "device_attitudes": own,
        "known_of_truth": sequence.truth_summary(),
        **{name: part and part.figures for name, part in sensors.items()},
    }
    return Inspection(sequence.name, figures, tuple(findings), fit, rest, tuple(lines))


def _timing(sequence: ImuSequence, given: int, not_finite: int) -> Assessment:
    """Assess the times of `given` samples, of which those ahead of others are left out."""
    time = sequence.time[np.isfinite(sequence.time)]
    steps = np.diff(time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
    gaps = np.flatnonzero(steps > GAP_STEPS * usual)
    forward = steps[(steps > 0) & (steps <= GAP_STEPS * usual)]
    jitter = float(np.median(np.abs(forward - usual))) if len(forward) else math.nan
    lost = int(np.round(steps[gaps] / usual - 1.0).sum()) if len(gaps) else 0
    figures = {
        "samples": given,
        "duration_s": sequence.duration,
        "rate_hz": sequence.rate,
        "jitter_s": jitter,  # median deviation of a step from the median step
        "gaps": [{"start_s": float(time[k]), "length_s": float(steps[k])} for k in gaps],
        "samples_lost_in_gaps": lost,
        "times_repeated": int((steps == 0).sum()),
        "times_backward": int((steps < 0).sum()),
        "times_ahead": given - len(sequence),
        "samples_not_finite": not_finite,
    }
    missing, ahead = "samples missing: none", ""
    if len(gaps):
        longest = gaps[int(np.argmax(steps[gaps]))]
        missing = (
            f"{lost} samples missing in {len(gaps)} places; "
            f"longest step {steps[longest]:.3f} s at {time[longest]:.1f} s"
        )
    if figures["times_ahead"]:
        ahead = f", {figures['times_ahead']} ahead of their time and left out"
    lines = [
        f"{given} samples, {sequence.duration:.1f} s, {sequence.rate:.1f} Hz, "
        f"jitter {1e3 * jitter:.2f} ms",
        missing,
        f"times: {figures['times_repeated']} repeated, {figures['times_backward']} backward{ahead}"
        f"; {not_finite} non-finite samples",
    ]
    return Assessment(figures, lines, [])


def _rest_lines(rest: Rest | None) -> list[str]:
    if rest is None:
        return ["at rest: never for a full second, so noise and bias are unknown"]
    bias = ", ".join(f"{value:+.5f}" for value in rest.gyro_bias_rad_s)
    return [
        f"at rest: {rest.seconds:.1f} s in {len(rest.stretches)} stretch"
        + "es" * (len(rest.stretches) != 1),
        f"  gyroscope: bias {bias} rad/s, noise {rest.gyro_noise_rad_s_sqrt_hz:.2e} rad/s/sqrt(Hz)",
        f"  accelerometer: {rest.accel_norm_m_s2:.4f} m/s^2 "
        f"({rest.accel_norm_m_s2 - STANDARD_GRAVITY:+.4f} relative to gravity), "
        f"noise {rest.accel_noise_m_s2_sqrt_hz:.2e} m/s^2/sqrt(Hz)",
    ]
