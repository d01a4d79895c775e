"""Findings about a recording's barometer: rate, noise, repeated samples, steps and jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_closing, median_filter

from stario.sequences.arrays import even_grid, runs
from stario.sequences.findings import Finding
from stario.sequences.sequence import Barometer, FloatArray
from stario.sequences.units import HIGHEST_HPA, LOWEST_HPA, METRES_PER_HPA, pressure_unit_of

_THINNED_S = 0.2
"""Step [s] over which the noise is measured: some phones interpolate or repeat samples in less."""

_GRID_S, _MEDIAN_S, _SIDE_S = 0.25, 1.0, 3.0
_STEP_M, _LEVEL, _WITHIN = 0.35, 0.5, 0.7
"""A step, as at a door, changes the height by this much [m], mostly within a second, between two
sides of 3 s that are level to a share of it: no stairs, lift or noise."""

_JUMP_M = 5.0
"""Change [m] within a second that neither a lift nor a door makes."""

_NOISY_M, _SLOW_HZ, _HELD_SHARE = 0.3, 0.5, 0.5
"""Noise, rate and share of repeated samples from which each is told."""


Changes = tuple[tuple[float, float], ...]
"""Time [s] and rise in height [m] of each sudden change of the pressure."""


@dataclass(frozen=True)
class PressureFindings:
    """Findings about a barometer, named as in `as_dict`.

    Attributes:
        samples: number of samples.
        rate_hz: median rate [Hz].
        pressure_median_hPa: median pressure [hPa].
        noise_m: standard deviation of a sample over fifths of a second, as a height [m].
        repeated_share: share of the samples that equal the one before.
        height_range_m: 98 % of the heights by the pressure lie within so many metres.
        steps: sudden steps, as at doors.
        jumps: sudden changes that no door makes, nor a lift.
    """

    samples: int
    rate_hz: float
    pressure_median_hPa: float
    noise_m: float
    repeated_share: float
    height_range_m: float
    steps: Changes
    jumps: Changes

    def as_dict(self) -> dict[str, object]:
        """Return the findings as plain values, with units in their names."""
        steps, jumps = (
            [{"time_s": time, "rise_m": rise} for time, rise in found]
            for found in (self.steps, self.jumps)
        )
        return vars(self) | {"steps": steps, "jumps": jumps}

    def lines(self) -> list[str]:
        """Return the findings as lines to print."""
        held = f", {self.repeated_share:.0%} repeated" if self.repeated_share > 0.0 else ""
        line = (
            f"barometer: {self.samples} samples, {self.rate_hz:.1f} Hz{held}, "
            f"{self.pressure_median_hPa:.1f} hPa; as heights: noise {self.noise_m:.2f} m, "
            f"within {self.height_range_m:.1f} m"
        )
        if self.steps:
            largest = max(self.steps, key=lambda step: abs(step[1]))
            line += f", sudden steps: {len(self.steps)} (largest {largest[1]:+.1f} m)"
        return [line]

    def findings(self) -> list[Finding]:
        """Return what stands out."""
        if not LOWEST_HPA <= self.pressure_median_hPa <= HIGHEST_HPA:
            return [_other_unit(self.pressure_median_hPa)]
        found = [_jumping(self.jumps)] if self.jumps else []
        if self.noise_m > _NOISY_M:
            text = f"barometer: a noise of {self.noise_m:.1f} m, as of wind or in a tight pocket"
            values = {"noise_m": self.noise_m}
            found.append(Finding("pressure_noise", text, level="note", values=values))
        if self.rate_hz < _SLOW_HZ or self.repeated_share > _HELD_SHARE:
            text = (
                f"barometer: {self.rate_hz:.2g} samples per second, of which "
                f"{self.repeated_share:.0%} repeat the last: lifts and stairs are seen late"
            )
            values = {"rate_hz": self.rate_hz, "repeated_share": self.repeated_share}
            found.append(Finding("pressure_held", text, level="note", values=values))
        return found


def _other_unit(value: float) -> Finding:
    text = f"barometer: found {value:.6g}, expected {LOWEST_HPA:g} to {HIGHEST_HPA:g} hPa"
    unit = pressure_unit_of(value)
    fix = f"it seems to be in {unit}" if unit else "is it an altitude?"
    return Finding("pressure_size", text, fix, values={"pressure": value})


def _jumping(jumps: Changes) -> Finding:
    time, rise = max(jumps, key=lambda jump: abs(jump[1]))
    text = f"barometer: jumps by {rise:+.0f} m at {time:.0f} s, as no height does"
    fix = "was the sensor pressed, or blown on? Or is it an altitude?"
    values = {"count": len(jumps), "time_s": time, "rise_m": rise}
    return Finding("pressure_jump", text, fix, values=values)


def assess_barometer(barometer: Barometer | None) -> PressureFindings | None:
    """Return the findings about a barometer; None without one or with fewer than three samples."""
    if barometer is None or len(barometer) < 3:
        return None
    time, hPa = barometer.time, barometer.pressure_hPa
    height = METRES_PER_HPA * (hPa[0] - hPa)
    steps, jumps = _sudden_changes(time, height)
    low, high = np.percentile(height, [1.0, 99.0])
    return PressureFindings(
        samples=len(barometer),
        rate_hz=barometer.rate,
        pressure_median_hPa=float(np.median(hPa)),
        noise_m=_noise(time, height),
        repeated_share=float((np.diff(hPa) == 0.0).mean()),
        height_range_m=float(high - low),
        steps=steps,
        jumps=jumps,
    )


def _noise(time: FloatArray, height: FloatArray) -> float:
    """Return the noise of a sample [m], from second differences, which leave out a steady climb."""
    fresh = np.flatnonzero(np.diff(height, prepend=np.nan) != 0.0)
    slots = np.floor((time[fresh] - time[fresh[0]]) / _THINNED_S)
    kept = fresh[np.diff(slots, prepend=-1.0) > 0.0]
    bend = np.diff(height[kept], n=2)
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6.0)) if len(bend) else 0.0


def _sudden_changes(time: FloatArray, height: FloatArray) -> tuple[Changes, Changes]:
    """Return the steps and the jumps."""
    grid = even_grid(time[0], time[-1], _GRID_S)
    side, gap = round(_SIDE_S / _GRID_S), round(_MEDIAN_S / _GRID_S)
    if len(grid) < 2 * side + gap or np.median(np.diff(time)) > 0.5 * _MEDIAN_S:
        return (), ()
    level = median_filter(np.interp(grid, time, height), gap + 1)
    sides = sliding_window_view(level, side)
    before, after = sides[: -side - gap], sides[side + gap :]
    rise = np.median(after, axis=1) - np.median(before, axis=1)
    level_to = np.maximum(np.ptp(before, axis=1), np.ptp(after, axis=1))
    size = np.abs(rise)
    within = np.sign(rise) * (after[:, 0] - before[:, -1])
    sudden = (size > _STEP_M) & (level_to < _LEVEL * size) & (within > _WITHIN * size)
    found = [a + int(np.argmax(size[a:b])) for a, b in runs(binary_closing(sudden, np.ones(gap)))]
    middle = grid[0] + _SIDE_S + 0.5 * _MEDIAN_S
    told = [(float(middle + _GRID_S * k), float(rise[k])) for k in found]
    return (
        tuple(change for change in told if abs(change[1]) <= _JUMP_M),
        tuple(change for change in told if abs(change[1]) > _JUMP_M),
    )
