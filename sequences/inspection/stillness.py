"""Stillness: stretches in which a device is stationary, and its sensors' statistics there.

One chi-square test serves all callers, each with its own factor: the scatter of both sensors about
their means against the white noise of a phone's IMU (`PHONE_NOISE`). The filter's own densities are
unsuitable here: they include errors of scale and alignment, which arise only in motion. (The test
of whether the mean force at the start gives the vertical is another one: a hand may tremble, but a
trolley must not accelerate; see `levelling`.)

Noise is the Allan deviation at 0.1 s times sqrt(0.1 s): the density of white noise, whatever the
rate and the sensor's filter above 10 Hz (IEEE Std 952, annex C).

Source: I. Skog et al., "Zero-velocity detection: an algorithm evaluation", 2010 (the test on both
sensors); the scatter about the mean replaces their known gravity and bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.arrays import runs, samples_in
from stario.sequences.clean_samples import clean_samples
from stario.sequences.noise import PHONE_NOISE
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.time_order import MAX_IMU_GAP

_INSPECTION_FACTOR = 6.0
"""Factor for a device at rest, used by inspection: its sensors may be noisier than a phone's."""

_USUAL_BIAS = 0.06
"""Mean rate [rad/s] that may be a bias without further evidence: 3.4 degrees per second."""

_PROBABILITY = 0.999
"""Probability that a sensor at rest passes the test."""

_BIN_S = 0.05
_BLOCK_BINS = 10
_SHORTEST_S = 1.0


def scatter_bound(count: float, seconds: float, factor: float) -> float:
    """Return the largest sum of squares about the mean of white noise of density `factor`.

    It is that of `count` samples, each in three axes, that span some seconds.
    """
    return factor**2 * count / seconds * chi2_quantile(_PROBABILITY, 3.0 * (count - 1.0))


def looks_still(gyro: float, accel: float, bound: float) -> bool:
    """Return whether sums of squares [rad^2/s^2], [m^2/s^4] are within a `scatter_bound`."""
    noise = PHONE_NOISE
    return gyro <= bound * noise.gyro_noise**2 and accel <= bound * noise.accel_noise**2


def is_still(gyro: FloatArray, accel: FloatArray, seconds: float, factor: float) -> bool:
    """Return whether samples (n, 3) [rad/s], [m/s^2] that span `seconds` show no motion.

    A steady turn has no scatter: the mean rate must also be a bias.
    """
    if len(gyro) < 2 or not _is_bias(gyro.mean(axis=0), accel, seconds):
        return False
    rates, forces = (float(np.square(x - x.mean(axis=0)).sum()) for x in (gyro, accel))
    return looks_still(rates, forces, scatter_bound(len(gyro), seconds, factor))


def _is_bias(rate: FloatArray, accel: FloatArray, seconds: float) -> bool:
    """Return whether a mean rate (3,) [rad/s] is a bias rather than a turn.

    A turn about a horizontal axis would turn gravity in the samples (n, 3) of the accelerometer.
    One about the vertical would not: a bias there must be of the size of that about the others.
    """
    if np.linalg.norm(rate) <= _USUAL_BIAS:
        return True
    force, half = accel.mean(axis=0), len(accel) // 2
    size = max(float(np.linalg.norm(force)), 1e-9)
    vertical = float(rate @ force) / size
    horizontal = float(np.linalg.norm(rate - vertical * force / size))
    change = float(np.linalg.norm(accel[half:].mean(axis=0) - accel[:half].mean(axis=0)))
    tilts = change > 0.5 * horizontal * size * 0.5 * seconds  # half of what a turn would give
    return abs(vertical) <= 2.0 * horizontal and not tilts


@dataclass(frozen=True, eq=False)
class Rest:
    """Sensor statistics at rest, named as in an inspection's figures.

    Attributes:
        stretches: first and last time of each stretch [s].
        gyro_bias_rad_s: (3,) mean rate [rad/s], including the earth's 7e-5 rad/s.
        gyro_noise_rad_s_sqrt_hz: density of white noise, root mean square over the axes.
        accel_norm_m_s2: mean magnitude of the force, with bias and scale error along gravity.
        accel_noise_m_s2_sqrt_hz: as that of the gyroscope.
    """

    stretches: tuple[tuple[float, float], ...]
    gyro_bias_rad_s: FloatArray
    gyro_noise_rad_s_sqrt_hz: float
    accel_norm_m_s2: float
    accel_noise_m_s2_sqrt_hz: float

    @property
    def seconds(self) -> float:
        """Total length of all stretches [s]."""
        return sum(stop - start for start, stop in self.stretches)


def find_rest(sequence: ImuSequence) -> Rest | None:
    """Find the stretches at rest; None if the device is never stationary for a second.

    Raises:
        InputError: as for `clean_samples`.
    """
    time, gyro, accel = clean_samples(sequence)
    per_bin = samples_in(_BIN_S, time)
    per_block = per_bin * _BLOCK_BINS
    blocks = len(time) // per_block
    if blocks == 0:
        return None
    used = blocks * per_block
    start = time[:used:per_block]
    stop = time[per_block - 1 : used : per_block]
    steps = np.diff(time[:used], append=time[used - 1]).reshape(blocks, per_block)
    unbroken = (steps < MAX_IMU_GAP).all(axis=1)  # also up to the next block
    rates, forces = (
        x[:used].reshape(blocks, _BLOCK_BINS, per_bin, 3).mean(2) for x in (gyro, accel)
    )
    pairs = zip(rates, forces, strict=True)
    quiet = np.array([is_still(w, f, _BLOCK_BINS * _BIN_S, _INSPECTION_FACTOR) for w, f in pairs])
    joined = unbroken & quiet
    spans = [(a, b) for a, b in runs(joined) if stop[b - 1] - start[a] >= _SHORTEST_S]
    if not spans:
        return None
    still_rates, still_forces = ([x[a:b] for a, b in spans] for x in (rates, forces))
    norms = np.linalg.norm(np.concatenate(still_forces).mean(axis=1), axis=1)
    tau = 2 * per_bin * float(np.median(np.diff(time)))
    return Rest(
        stretches=tuple((float(start[a]), float(stop[b - 1])) for a, b in spans),
        gyro_bias_rad_s=np.concatenate(still_rates).mean(axis=(0, 1)),
        gyro_noise_rad_s_sqrt_hz=_density(still_rates, tau),
        accel_norm_m_s2=float(norms.mean()),
        accel_noise_m_s2_sqrt_hz=_density(still_forces, tau),
    )


def _density(stretches: list[FloatArray], tau: float) -> float:
    """Return the Allan deviation of means over two bins, as a density of white noise."""
    squares = [
        np.square(np.diff(part.reshape(-1, 2, 3).mean(axis=1), axis=0)) for part in stretches
    ]
    return float(np.sqrt(0.5 * np.concatenate(squares).mean() * tau))
