"""Simulated walks beside recordings: motion by band, step rate, and errors, by way of carrying.

A simulator that moves like people lets tests, training and the demonstration say something about
real walks. Recordings are those of archives whose attribute `carry` is in `WAYS`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.signal import butter, sosfiltfilt, welch

from stario.fusion.evaluation.checks.fusion import fitted_error
from stario.fusion.evaluation.compare import Metrics, measure
from stario.fusion.evaluation.known_positions import length_ratio, true_path
from stario.fusion.evaluation.scores import Column, scored, table
from stario.fusion.evaluation.tracks import network_track
from stario.fusion.imu.inference import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.values.config import NavigatorConfig
from stario.sequences.arrays import even_grid, generator, interpolated, rms
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.magnetometer import INDOOR_FIELD
from stario.sequences.simulation.walks import WalkStyle, generate_walk

WAYS = {
    "pocket": ("pocket (front)", 0.8),
    "back-pocket": ("pocket (back)", 0.8),
    "texting": ("handheld (texting)", 0.55),
    "call": ("handheld (at the ear)", 0.65),
    "swinging": ("swinging", 0.9),
    "bag": ("bag", 1.25),
    "handheld": ("handheld", 1.2),
    "in-front": ("handheld (flat in front)", 1.2),
}
"""The simulator's ways of carrying: an archive's attribute `carry`, and the preferred speed [m/s]
of the simulated walks: the archives' medians while walking, since bands grow with the speed."""

BANDS = ((0.5, 3.0), (3.0, 6.0), (6.0, 10.0), (10.0, 20.0))
"""Edges [Hz] of the bands: steps, their harmonics, what rings after heel strikes, and its end."""

_RATE = 100.0
_STEP_RATES, _STEP_WINDOW = (1.1, 2.8), 5.0
"""Possible step rates [Hz], and seconds of a spectrum that shows them."""

SIMULATED, RECORDED = "simulated", "recorded"


def simulated_walk(carry: str, seed: int, seconds: float = 120.0) -> ImuSequence:
    """Simulate a person, drawn with the walk, who carries a phone in a building."""
    rng = generator(seed)
    speed = WAYS[carry][1] * float(rng.uniform(0.8, 1.2))
    style = replace(WalkStyle.random(rng), carry=carry, next_carry="", preferred_speed=speed)
    walk = generate_walk(seed, seconds, style=style, corridors=True)
    name = f"{carry} {seed}"
    return simulate_imu(walk, _RATE, PHONE_IMU, seed, name=name, magnetic_field=INDOOR_FIELD)


def carry_of(sequence: ImuSequence) -> str:
    """Return the simulator's name of how a recording was carried.

    Raises:
        InputError: its attributes do not say, or it is none of `WAYS`.
    """
    carry = str(sequence.attributes.get("carry", "none"))
    carried = {attribute: way for way, (attribute, _) in WAYS.items()}
    if carry not in carried:
        where = f"{sequence.name}: attribute carry"
        raise InputError(where, carry, f"one of {', '.join(carried)}")
    return carried[carry]


def motion_scores(
    model: Predictor, sequence: ImuSequence, config: NavigatorConfig, carry: str, kind: str
) -> pd.DataFrame:
    """Score a recording's motion, as `motion`, and the errors of network and track [%] of its path.

    Args:
        model: network.
        sequence: recording with poses, positions or waypoints.
        config: configuration of the navigator.
        carry: carrying mode, the rows' group.
        kind: `SIMULATED` or `RECORDED`.

    Raises:
        InputError: it has no ground truth, or cannot be run.
    """
    length = true_path(sequence)
    navigator = Navigator(model, config, backend="graph")
    observed = navigator.observe(sequence)
    figures: Metrics = dict(motion(sequence))
    figures["speed"] = length / sequence.duration
    for name, track in (("network", network_track(observed)), ("track", navigator.track(observed))):
        figures[f"{name}_length"] = length_ratio(track, sequence)
        figures[f"{name}_percent"] = 100.0 * fitted_error(measure(track, sequence)) / length
    return scored(sequence.name, {kind: figures}, carry)


def motion(sequence: ImuSequence) -> dict[str, float]:
    """Return how a device moves.

    It is the root mean square in each band of the specific force's norm [m/s^2], which no attitude
    changes, that of the angular rate [rad/s], and the median step rate [Hz].
    """
    time = even_grid(float(sequence.time[0]), float(sequence.time[-1]), 1.0 / _RATE)
    force = np.linalg.norm(interpolated(time, sequence.time, sequence.accel), axis=1)
    found = {}
    for low, high in BANDS:
        band = butter(4, (low, high), "bandpass", fs=_RATE, output="sos")
        found[f"force_{low:g}"] = rms(sosfiltfilt(band, force)[:, None])
    return {**found, "rate": rms(sequence.gyro), "step_rate": float(np.median(_step_rates(force)))}


def _step_rates(force: FloatArray) -> FloatArray:
    """Return the strongest frequency (M,) [Hz] of the force's norm in each window."""
    count = min(round(_STEP_WINDOW * _RATE), len(force))
    windows = force[: len(force) // count * count].reshape(-1, count)
    f, power = welch(windows, _RATE, nperseg=count, nfft=4 * count)
    possible = (f > _STEP_RATES[0]) & (f < _STEP_RATES[1])
    return np.asarray(f[possible][np.argmax(power[:, possible], axis=1)])


def motion_table(scores: pd.DataFrame) -> str:
    """Return for each way of carrying a row of simulated walks and one of recordings."""
    columns = [
        Column("n", "rate", ".0f", len),
        *(Column(f"{low:g}-{high:g} Hz", f"force_{low:g}", ".2f") for low, high in BANDS),
        Column("rate", "rate", ".2f"),
        Column("steps", "step_rate", ".2f"),
        Column("speed", "speed", ".2f"),
        Column("network: length", "network_length", ".2f"),
        Column("%", "network_percent", ".1f"),
        Column("track: length", "track_length", ".2f"),
        Column("%", "track_percent", ".1f"),
    ]
    notes = [
        "medians; force by band [m/s^2]: root mean square of its norm; rate: of the angular rate "
        "[rad/s]; steps [Hz]; speed: path over time [m/s]",
        "network, track: length per true length; error after a fit of yaw and position in % of the "
        "path, which is smaller where a way returns often",
    ]
    if RECORDED not in set(scores["track"]):
        notes.append("recordings to compare with: none given (PATH: archives with attribute carry)")
    rows = (
        (f"{carry}, {kind}", part) for (carry, kind), part in scores.groupby(["group", "track"])
    )
    return table(rows, columns, ("carried",), notes)
