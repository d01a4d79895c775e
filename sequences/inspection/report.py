"""Inspection of a recording: its properties and problems, before anything is computed from it.

Without ground truth the gyroscope's axes and signs are compared with the accelerometer's. Averaged
over a second, the specific force of a carried device is close to gravity. When the device tilts,
gravity turns in its axes as the gyroscope says. Rotated by it into a frame that does not turn, the
averages of successive seconds agree; with other axes or signs they differ by about as much as they
do in the device's axes. A wrong sign of the whole accelerometer changes neither.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from stario.sequences.arrays import check_type, samples_in
from stario.sequences.attitude.rotations import integrated_gyro
from stario.sequences.clean_samples import clean_samples, cleaned, finite_samples, unbroken, usable
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
from stario.sequences.sequence import GAP_STEPS, STANDARD_GRAVITY, FloatArray, ImuSequence
from stario.sequences.truth.fit import TruthFit
from stario.sequences.truth.problems import assess_truth

_COMPARED = "units, signs and axes: compared"

_MIN_TILT = 0.2
"""Change of gravity between successive seconds in the device's axes that counts, relative to it."""

_MAX_FORCE = 1.15
"""Mean magnitude of the force, relative to gravity, above which a runner hides it."""

_MIN_SECONDS = 2.5
"""Minimum length of an unbroken stretch [s]: two averages and a margin."""

_MIN_TILTS = 5
"""Number of such changes needed for a verdict."""

_MAX_UNEXPLAINED = 0.65
"""Share of the squared changes left unexplained above which the axes differ. Of 46 recordings of
all sets one exceeds it (median 0.1); with two axes swapped or all signs changed, nine in ten do,
with one sign changed two in three."""


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
    findings, axes, refusal = sample_findings(sequence) + dead_axes(sequence), None, ""
    clean, rest, magnetic = sequence, None, None
    try:
        findings += unit_findings(sequence)
        clean = cleaned(sequence)  # once: it counts in a warning what it drops
        axes = _compare_gyro_axes(clean)
        findings += axes.findings
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
    if axes:
        lines += [_COMPARED] if fit else axes.lines
    figures = {
        **timing.figures,
        "accel_norm_mean_m_s2": accel,
        "gyro_norm_mean_rad_s": gyro,
        "rest": rest and {"seconds": rest.seconds, **vars(rest)},
        "gyro_axes": axes and axes.figures,
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


def _compare_gyro_axes(sequence: ImuSequence) -> Assessment:
    """Compare how gravity turns in the device's axes with the gyroscope.

    The figure "tilts" is the number of changes of gravity, "unexplained" the share of them that
    the gyroscope does not explain, by sums of squares; NaN without any.
    """
    time, gyro, accel = clean_samples(sequence)
    rows = [
        _changes(time[start:stop], gyro[start:stop], accel[start:stop])
        for start, stop in unbroken(time)
        if time[stop - 1] - time[start] > _MIN_SECONDS
    ]
    changes = np.concatenate([np.empty((0, 2)), *rows])
    left, total = changes.sum(axis=0)
    tilts, unexplained = len(changes), float(left / total) if len(changes) else math.nan
    figures = {"tilts": tilts, "unexplained": unexplained}
    if tilts < _MIN_TILTS:
        line = "units: compared; the device tilts too seldom to compare the sensors' axes"
        return Assessment(figures, [line], [])
    found = []
    if unexplained > _MAX_UNEXPLAINED:
        text = (
            f"gyroscope: leaves {unexplained:.0%} of gravity's changes in {tilts} tilts "
            "unexplained, expected less than half"
        )
        fix = "are its axes and signs the accelerometer's? (On rides, accelerations look like "
        found.append(Finding("gyro_axes", text, f"{fix}tilts.)", values=figures))
    return Assessment(figures, [_COMPARED], found)


def _changes(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Return unexplained and all squared changes (M, 2) of successive mean forces that count."""
    size = samples_in(1.0, time)
    count = len(time) // size
    R_0B = integrated_gyro(time, gyro)
    whole = slice(0, count * size)
    force_0 = R_0B.apply(accel)[whole].reshape(count, size, 3).mean(axis=1)
    magnitude = np.linalg.norm(accel[whole], axis=1).reshape(count, size).mean(axis=1)
    middle = R_0B[size // 2 : count * size : size]
    change_0 = np.linalg.norm(np.diff(force_0, axis=0), axis=1)
    change_B = np.linalg.norm(np.diff(middle.inv().apply(force_0), axis=0), axis=1)
    calm = magnitude < _MAX_FORCE * STANDARD_GRAVITY
    counts = calm[1:] & calm[:-1] & (change_B > _MIN_TILT * STANDARD_GRAVITY)
    changes: FloatArray = np.square(np.column_stack([change_0, change_B])[counts])
    return changes
