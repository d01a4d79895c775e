"""Findings about a recording's magnetometer: verdict, words and problems."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.sequences.findings import Finding
from stario.sequences.sequence import FloatArray
from stario.sequences.units import magnetic_advice

LAGS_S = np.arange(-0.05, 0.151, 0.01)
"""Lags of the time stamps that are tried [s]."""

_SIZES_UT = (15.0, 90.0)
_LEVEL_UT = 6.0
_VERDICTS = (("good", math.radians(12.0), 0.75), ("coarse", math.radians(25.0), 0.5))
"""Maximum RMS of the bearing [rad] and minimum correlation of each verdict."""

WINDOW_S, _TOLD_S = 60.0, 40.0
"""Span within which the bearing's steadiness is stated, and below which there is no verdict [s]:
a line absorbs most of what happens in a shorter one."""

_REPORTED_SHARE = 0.5
"""Share of half seconds with rotation above which an extrapolated field is reported."""

_UP_RAD = math.radians(20.0)
_IRON_UT = 10.0
_SURE = 5.0
"""Upward dip and hard iron above which a problem is reported; components of hard iron count if they
exceed this many of their standard deviations."""


@dataclass(frozen=True, eq=False)
class MagneticFindings:
    """Findings about a magnetometer.

    Attributes:
        samples: number of samples as recorded.
        rate_hz: median rate [Hz].
        size_median_uT: median magnitude of the field [uT].
        size_p10_p90_uT: 10th and 90th percentile of the magnitude [uT].
        dip_rad: median angle below the horizontal [rad].
        correlation_with_gyroscope: correlation of dm/dt and -w x (m - b); None if the device hardly
            turns.
        lag_s: time by which the samples are stamped late [s]; None in that case, and if it is
            outside the range searched.
        hard_iron_uT: hard iron b (3,) [uT]; None if the lag is.
        hard_iron_sigma_uT: standard deviation of the hard iron (3,) [uT]; None if the lag is.
        assessed_s: span of the samples that were assessed [s].
        levelled_bearing_rms_rad: median RMS of the bearing about a line over a minute [rad].
        gyroscope_drift_rad_s: median slope of that line: the gyroscope's drift in yaw [rad/s].
        held_share: share of the half seconds with rotation in which the device extrapolated the
            field instead of measuring it.
    """

    samples: int
    rate_hz: float
    size_median_uT: float
    size_p10_p90_uT: tuple[float, float]
    dip_rad: float
    correlation_with_gyroscope: float | None
    lag_s: float | None
    hard_iron_uT: FloatArray | None
    hard_iron_sigma_uT: FloatArray | None
    assessed_s: float
    levelled_bearing_rms_rad: float
    gyroscope_drift_rad_s: float
    held_share: float

    @property
    def verdict(self) -> str:
        """Quality of the levelled bearing as a yaw reference.

        It is "good", "coarse", "not usable", or "too short to tell".
        """
        if self.assessed_s < _TOLD_S:
            return "too short to tell"
        level = self.size_median_uT * math.cos(self.dip_rad)
        agreement = self.correlation_with_gyroscope
        for word, steady, follows in _VERDICTS:
            agrees = agreement is None or agreement > follows
            if self.levelled_bearing_rms_rad < steady and level > _LEVEL_UT and agrees:
                return word
        return "not usable"

    def as_dict(self) -> dict[str, object]:
        """Return the findings as plain values, with units in their names."""
        return vars(self) | {"verdict": self.verdict}

    def lines(self) -> list[str]:
        """Return the findings as lines to print."""
        low, high = self.size_p10_p90_uT
        lines = [
            f"magnetometer: {self.samples} samples, {self.rate_hz:.1f} Hz, "
            f"{self.size_median_uT:.1f} uT (80 % within {low:.1f} to {high:.1f}), "
            f"dip {math.degrees(self.dip_rad):.0f} deg"
        ]
        if self.correlation_with_gyroscope is not None:
            lines.append(
                f"  against the gyroscope: correlation {self.correlation_with_gyroscope:.3f}, "
                f"{self._lag_words()}"
            )
        within = " within a minute" if self.assessed_s > WINDOW_S else ""
        lines.append(
            f"  levelled bearing over {self.assessed_s:.0f} s: steady to "
            f"{math.degrees(self.levelled_bearing_rms_rad):.1f} deg{within}, drifts by "
            f"{math.degrees(60.0 * self.gyroscope_drift_rad_s):+.1f} deg/min against the "
            f"gyroscope; as a yaw reference: {self.verdict}"
        )
        if self.held_share > _REPORTED_SHARE:
            lines.append(
                f"  constant in magnitude: extrapolated by the device's own gyroscope "
                f"{self.held_share:.0%} of the time that it turns, and given little weight then"
            )
        return lines

    def _lag_words(self) -> str:
        if self.lag_s is None or self.hard_iron_uT is None or self.hard_iron_sigma_uT is None:
            first, last = (1e3 * lag for lag in (LAGS_S[0], LAGS_S[-1]))
            return f"lag outside {first:+.0f} to {last:+.0f} ms; lag and hard iron unknown"
        pairs = zip(self.hard_iron_uT, self.hard_iron_sigma_uT, strict=True)
        iron = ", ".join(f"{b:+.1f} +- {s:.1f}" for b, s in pairs)
        return f"lag {1e3 * self.lag_s:+.0f} ms, hard iron {iron} uT"


def certain_iron(iron: FloatArray | None, sigma: FloatArray | None) -> FloatArray | None:
    """Return the hard iron if it must be removed before the field is assessed."""
    if iron is None or sigma is None:
        return None
    sure = np.abs(iron) > _SURE * sigma
    return iron if np.linalg.norm(iron[sure]) > _IRON_UT else None


def magnetic_findings(found: MagneticFindings) -> list[Finding]:
    """Return what stands out about a magnetometer."""
    result = []
    iron = certain_iron(found.hard_iron_uT, found.hard_iron_sigma_uT)
    agreement, size = found.correlation_with_gyroscope, found.size_median_uT
    if not _SIZES_UT[0] < size < _SIZES_UT[1]:
        text = f"magnetometer: found {size:.3g} uT, expected the earth's 25 to 65"
        fix = magnetic_advice(size) or "is it uncalibrated, in another unit or near a magnet?"
        result.append(Finding("field_size", text, fix, values={"size_uT": size}))
    if agreement is not None and agreement < _VERDICTS[-1][2]:
        text = f"magnetometer: does not follow the gyroscope (correlation {agreement:.2f})"
        fix = "a disturbed field, stale readings or different axes"
        result.append(Finding("field_axes", text, fix, values={"correlation": agreement}))
    if iron is not None:
        offset = ", ".join(f"{b:+.0f}" for b in iron)
        text = f"magnetometer: the device adds a constant field of {offset} uT (hard iron)"
        result.append(Finding("hard_iron", text, level="note", values={"iron_uT": iron.tolist()}))
    if found.dip_rad < -_UP_RAD:
        up = math.degrees(-found.dip_rad)
        text = f"magnetometer: points up by {up:.0f} degrees, as south of the magnetic equator"
        fix = "elsewhere, the accelerometer has Apple's sign: pass `--accel-sign apple`"
        result.append(Finding("field_up", text, fix, values={"up_deg": up}))
    return result
