"""Inspection of a recording: its properties and problems, before anything is computed from it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from stario.sequences.arrays import check_type
from stario.sequences.clean_samples import finite_samples, usable
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding, verdict
from stario.sequences.inspection.checks import unit_findings
from stario.sequences.inspection.constant_values import dead_axes
from stario.sequences.inspection.gyro_axes import GyroAxes, compare_gyro_axes
from stario.sequences.inspection.magnetic import (
    MagneticFindings,
    assess_magnetometer,
)
from stario.sequences.inspection.outside_sensors import (
    PressureFindings,
    SatelliteFindings,
    assess_barometer,
    assess_satellites,
)
from stario.sequences.inspection.samples import (
    clock_findings,
    sample_findings,
    without_times_ahead,
)
from stario.sequences.inspection.stillness import Rest, find_rest
from stario.sequences.sequence import (
    GAP_STEPS,
    STANDARD_GRAVITY,
    ImuSequence,
    Trajectory,
    is_gap,
)
from stario.sequences.truth.findings import (
    fit_as_dict,
    fit_lines,
    known_position_findings,
    position_line,
    positions_as_dict,
    scale_findings,
)
from stario.sequences.truth.fit import TruthFit, YawDrift, yaw_drift
from stario.sequences.truth.positions import PositionFit
from stario.sequences.truth.problems import examine_truth


@dataclass(frozen=True)
class Timing:
    """Timing of the samples, named as in `Inspection.as_dict`.

    Attributes:
        samples: number of samples as recorded.
        duration_s: time between the first and the last sample [s].
        rate_hz: median rate [Hz].
        jitter_s: median deviation of a step from the median step [s].
        gaps: start and length [s] of each step that has lost samples.
        samples_lost_in_gaps: number of samples missing there.
        times_repeated: number of samples at the time of the previous one.
        times_backward: number of samples earlier than the previous one.
        times_ahead: number of samples ahead of those after them; the others do not count these.
        samples_not_finite: number of samples with a time or a value that is not finite.
    """

    samples: int
    duration_s: float
    rate_hz: float
    jitter_s: float
    gaps: tuple[tuple[float, float], ...]
    samples_lost_in_gaps: int
    times_repeated: int
    times_backward: int
    times_ahead: int
    samples_not_finite: int


@dataclass(frozen=True)
class Coverage:
    """Ground truth available for a recording, named as in `Inspection.as_dict`.

    Attributes:
        coverage: share of the IMU's samples for which the truth is known.
        rate_hz: median rate of the truth [Hz].
        gaps: number of gaps in the truth that are too long to interpolate across.
        longest_gap_s: longest step of the truth [s].
        path_m: length of the path [m].
    """

    coverage: float
    rate_hz: float
    gaps: int
    longest_gap_s: float
    path_m: float


@dataclass(frozen=True, eq=False)
class Inspection:
    """Findings about a recording.

    Attributes:
        name: name of the recording.
        timing: timing of its samples.
        accel_norm: mean magnitude of the accelerometer's samples [m/s^2].
        gyro_norm: mean magnitude of the gyroscope's samples [rad/s].
        rest: sensor statistics at rest; None if the device never rests.
        coverage: coverage by ground truth; None without one.
        fit: fit of truth and gyroscope; None if they cannot be compared.
        positions: comparison of the truth's positions with the accelerometer, likewise.
        findings: what stands out.
        truth: description of the ground truth.
        device_attitude: number of attitudes logged by the device's own sensor fusion.
        sensors: findings about "magnetometer", "barometer" and "satellites"; None without one or
            with too few samples.
        yaw: drift of the gyroscope's yaw from the true one; None if it cannot be determined.
        axes: agreement of the gyroscope with gravity; None if units are wrong.
    """

    name: str
    timing: Timing
    accel_norm: float
    gyro_norm: float
    rest: Rest | None
    coverage: Coverage | None
    fit: TruthFit | None
    positions: PositionFit | None
    findings: tuple[Finding, ...]
    truth: str
    sensors: Mapping[str, MagneticFindings | PressureFindings | SatelliteFindings | None]
    device_attitude: int
    yaw: YawDrift | None
    axes: GyroAxes | None

    def as_dict(self) -> dict[str, object]:
        """Return the findings as plain values, with units in their names."""
        rest = self.rest
        return {
            "recording": self.name,
            **vars(self.timing),
            "gaps": [{"start_s": start, "length_s": length} for start, length in self.timing.gaps],
            "accel_norm_mean_m_s2": self.accel_norm,
            "gyro_norm_mean_rad_s": self.gyro_norm,
            "rest": rest
            and {
                "seconds": rest.seconds,
                "gyro_bias_rad_s": rest.gyro_bias,
                "gyro_noise_rad_s_sqrt_hz": rest.gyro_noise,
                "accel_norm_m_s2": rest.accel_norm,
                "accel_noise_m_s2_sqrt_hz": rest.accel_noise,
            },
            "gyro_axes": self.axes and asdict(self.axes),
            "truth": self.coverage and asdict(self.coverage),
            "truth_against_gyroscope": self.fit and fit_as_dict(self.fit, self.yaw),
            "positions_against_accelerometer": self.positions and positions_as_dict(self.positions),
            "device_attitudes": self.device_attitude,
            "known_of_truth": self.truth,
            **{name: found and found.as_dict() for name, found in self.sensors.items()},
            "verdict": [asdict(finding) for finding in verdict(self.findings)],
        }

    def lines(self) -> list[str]:
        """Return the findings as lines to print."""
        compared = "units: compared; the device tilts too seldom to compare the sensors' axes"
        if self.fit or (self.axes and self.axes.compared):
            compared = "units, signs and axes: compared"
        return [
            *self._timing_lines(),
            f"accelerometer: {self.accel_norm:.3f} m/s^2 on average; "
            f"gyroscope: {self.gyro_norm:.3f} rad/s",
            *self._rest_lines(),
            *(line for found in self.sensors.values() if found for line in found.lines()),
            *([f"device's own attitudes: {self.device_attitude}"] if self.device_attitude else []),
            *self._truth_lines(),
            *([] if self.refused else [compared]),
        ]

    @property
    def refused(self) -> bool:
        """Whether no track can be computed: units or samples are wrong."""
        return any(found.code == "refused" for found in self.findings)

    def _timing_lines(self) -> list[str]:
        t = self.timing
        lines = [
            f"{t.samples} samples, {t.duration_s:.1f} s, {t.rate_hz:.1f} Hz, "
            f"jitter {1e3 * t.jitter_s:.2f} ms"
        ]
        if t.gaps:
            start, length = max(t.gaps, key=lambda gap: gap[1])
            lines.append(
                f"{t.samples_lost_in_gaps} samples missing in {len(t.gaps)} places; "
                f"longest step {length:.3f} s at {start:.1f} s"
            )
        else:
            lines.append("samples missing: none")
        ahead = f", {t.times_ahead} ahead of their time and left out" if t.times_ahead else ""
        lines.append(
            f"times: {t.times_repeated} repeated, {t.times_backward} backward{ahead}; "
            f"{t.samples_not_finite} non-finite samples"
        )
        return lines

    def _rest_lines(self) -> list[str]:
        rest = self.rest
        if rest is None:
            return ["at rest: never for a full second, so noise and bias are unknown"]
        bias = ", ".join(f"{value:+.5f}" for value in rest.gyro_bias)
        return [
            f"at rest: {rest.seconds:.1f} s in {len(rest.stretches)} stretch"
            + "es" * (len(rest.stretches) != 1),
            f"  gyroscope: bias {bias} rad/s, noise {rest.gyro_noise:.2e} rad/s/sqrt(Hz)",
            f"  accelerometer: {rest.accel_norm:.4f} m/s^2 "
            f"({rest.accel_norm - STANDARD_GRAVITY:+.4f} relative to gravity), "
            f"noise {rest.accel_noise:.2e} m/s^2/sqrt(Hz)",
        ]

    def _truth_lines(self) -> list[str]:
        coverage, fit = self.coverage, self.fit
        if coverage is None:
            return [f"truth: {self.truth}"]
        lines = [
            f"truth: covers {100 * coverage.coverage:.1f} % of the samples, "
            f"{coverage.rate_hz:.1f} Hz, {coverage.gaps} gaps "
            f"(longest step {coverage.longest_gap_s:.2f} s), path of {coverage.path_m:.1f} m"
        ]
        if fit is not None:
            lines += [*fit_lines(fit, self.yaw), position_line(self.positions)]
        return lines


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
    try:
        findings += unit_findings(sequence)
        axes = compare_gyro_axes(sequence)
        findings += axes.findings()
    except InputError as error:
        field = error.field.removeprefix(f"{sequence.name}: ")
        text = f"{field}: found {error.found}, expected {error.expected}"
        findings.append(Finding("refused", text, error.fix))
        refusal = error.fix or text
    truth = examine_truth(sequence, refusal)
    findings += truth.findings
    yaw = None
    if truth.fit is not None and not truth.fit.one_axis:
        yaw = yaw_drift(replace(sequence, truth=truth.truth), truth.fit)
        findings += scale_findings(truth.fit, yaw)
    try:
        rest, magnetic = find_rest(sequence), assess_magnetometer(sequence)
    except InputError:  # an invalid rate, which was reported
        rest = magnetic = None
    sensors = {
        "magnetometer": magnetic,
        "barometer": assess_barometer(sequence.barometer),
        "satellites": assess_satellites(sequence.satellites),
    }
    for found in sensors.values():
        findings += found.findings() if found else ()
    findings += clock_findings(sequence) + known_position_findings(sequence)
    return Inspection(
        name=sequence.name,
        timing=_timing(sequence, given, int((~finite).sum())),
        accel_norm=float(np.linalg.norm(sequence.accel[valid], axis=1).mean()),
        gyro_norm=float(np.linalg.norm(sequence.gyro[valid], axis=1).mean()),
        rest=rest,
        coverage=None if sequence.truth is None else _coverage(sequence, sequence.truth),
        fit=truth.fit,
        positions=truth.positions,
        findings=tuple(findings),
        truth=sequence.truth_summary(),
        device_attitude=0 if sequence.device_attitude is None else len(sequence.device_attitude),
        sensors=sensors,
        yaw=yaw,
        axes=axes,
    )


def _timing(sequence: ImuSequence, given: int, not_finite: int) -> Timing:
    time = sequence.time[np.isfinite(sequence.time)]
    steps = np.diff(time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
    gaps = np.flatnonzero(steps > GAP_STEPS * usual)
    forward = steps[(steps > 0) & (steps <= GAP_STEPS * usual)]
    return Timing(
        samples=given,
        duration_s=sequence.duration,
        rate_hz=sequence.rate,
        jitter_s=float(np.median(np.abs(forward - usual))) if len(forward) else math.nan,
        gaps=tuple((float(time[k]), float(steps[k])) for k in gaps),
        samples_lost_in_gaps=int(np.round(steps[gaps] / usual - 1.0).sum()) if len(gaps) else 0,
        times_repeated=int((steps == 0).sum()),
        times_backward=int((steps < 0).sum()),
        times_ahead=given - len(sequence),
        samples_not_finite=not_finite,
    )


def _coverage(sequence: ImuSequence, truth: Trajectory) -> Coverage:
    times = np.unique(sequence.time[np.isfinite(sequence.time)])
    known = truth.time[truth.valid]
    steps = np.diff(known)
    return Coverage(
        coverage=float(truth.covers(times).mean()) if len(known) > 1 else 0.0,
        rate_hz=float(1.0 / np.median(steps)) if len(steps) else 0.0,
        gaps=int(is_gap(steps).sum()),
        longest_gap_s=float(steps.max(initial=0.0)),
        path_m=truth.path_length(),
    )
