"""Virtual IMUs on motion capture: a device at a place on a body, as a recording with exact truth.

The device is fixed to a joint, and its poses are reduced to what a capture knows: markers tremble
on the skin above some 8 Hz. What is then missing is added as motion of the device, so that truth
and measurements agree exactly: every foot that lands excites a damped oscillation of the device on
soft tissue, cloth and grip (`Place.shaken`), about as strong as between 6 and 20 Hz in recordings
of real devices carried so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.interpolate import make_interp_spline
from scipy.signal import bilinear, butter, find_peaks, lfilter, lfilter_zi, sosfiltfilt
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import check_choice, check_type, generator
from stario.sequences.attitude.rotations import about_z
from stario.sequences.attitude.stacks import composed
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, ImuErrors, simulate_imu
from stario.sequences.simulation.motion_capture import BodyMotion, joint_of
from stario.sequences.simulation.routes import drift, smoothed

_RATE = 200.0
"""Rate of a device's poses [Hz]."""

_TRIMMED = 0.2
"""Time at either end of a clip in which its filter has not settled [s]."""

_SHORTEST = 1.5
"""Minimum length of a clip [s]."""

_HEADING_SIGMA = 0.5
"""Deviation of the Gaussian that smooths the heading of a device held in front [s]."""

_LANDING = 0.25
"""Minimum speed at which a foot that lands sinks [m/s]."""

_ROTATED = 0.25
"""Angular rate of the oscillation per acceleration [rad/s per m/s^2]."""


@dataclass(frozen=True)
class Place:
    """A place on the body.

    Attributes:
        joint: joint to which the device is fixed; of a limb, without the side.
        towards: joint at the other end of the segment; empty for the trunk and the head, whose
            direction along the segment is up.
        offset: where the device is: ahead and outward [m], and along the segment, in lengths of
            it, or up [m].
        cutoff: range of the low-pass filter's cutoff [Hz].
        shaken: acceleration of the device's oscillation, relative to that of the hips [1].
        resonance: range of the oscillation's resonance [Hz].
    """

    joint: str
    towards: str
    offset: tuple[float, float, float]
    cutoff: tuple[float, float]
    shaken: float
    resonance: tuple[float, float]


_MARKERS, _HEAD = (5.0, 9.0), (3.5, 6.5)
_LOOSE, _HELD = (5.0, 13.0), (4.0, 9.0)

PLACES = {
    "front-pocket": Place("thigh", "shin", (0.09, 0.05, 0.3), _MARKERS, 0.7, _LOOSE),
    "back-pocket": Place("hips", "", (-0.12, 0.08, -0.08), _MARKERS, 0.6, _LOOSE),
    "belt": Place("hips", "", (0.1, 0.12, 0.05), _MARKERS, 0.4, _LOOSE),
    "jacket": Place("chest", "", (0.12, 0.1, 0.0), _MARKERS, 0.4, _LOOSE),
    "bag": Place("chest", "", (-0.15, 0.05, -0.1), _MARKERS, 0.4, _LOOSE),
    "swinging": Place("hand", "forearm", (0.02, 0.0, -0.35), _MARKERS, 0.2, _HELD),
    "wrist": Place("forearm", "hand", (0.0, 0.03, 0.9), _MARKERS, 0.2, _HELD),
    "ear": Place("head", "", (0.03, 0.09, 0.08), _HEAD, 0.2, _HELD),
    "head": Place("head", "", (0.0, 0.02, 0.18), _HEAD, 0.2, _LOOSE),
    "in-front": Place("chest", "", (0.35, 0.0, -0.1), _HEAD, 0.2, _HELD),
    "foot": Place("foot", "shin", (0.08, 0.0, 0.0), (7.0, 9.0), 0.7, _LOOSE),
}
"""Places on the body, by name: `ear` is a phone at it, `in-front` one that is read while walking,
whose heading follows the body's smoothly."""


def places_on(motion: BodyMotion) -> list[str]:
    """Return the places for which a capture has the joints."""
    known = {joint.rpartition("_")[2] for joint in motion.position_W}
    return [n for n, p in PLACES.items() if {p.joint, p.towards or p.joint} <= known]


def virtual_imu(
    motion: BodyMotion,
    place: str,
    rate: float = 200.0,
    errors: ImuErrors = PHONE_IMU,
    seed: int = 0,
) -> ImuSequence:
    """Simulate the IMU of a device on a captured body, with its poses as truth.

    Args:
        motion: the capture, from `read_body`.
        place: one of `PLACES`.
        rate: sampling rate of the IMU [Hz].
        errors: errors of the sensors.
        seed: seed of all draws: the side of the body, how the device is turned, its filter and
            oscillation, and the sensors' errors.

    Raises:
        InputError: the place is unknown, the capture lacks its joint or is too short, or rate or
            seed is out of range.
    """
    trajectory = carried_on(motion, place, seed)
    sequence = simulate_imu(trajectory, rate, errors, seed, name=f"{motion.name} {place}")
    return replace(sequence, attributes={**motion.attributes, "carry": place})


def carried_on(motion: BodyMotion, place: str, seed: int = 0) -> Trajectory:
    """Return the poses of a device at a place on a captured body; arguments as `virtual_imu`."""
    check_type("motion", motion, BodyMotion, "read_body(path) returns one")
    where = PLACES[check_choice("carry", place, PLACES)]
    least = _SHORTEST + 2.0 * _TRIMMED
    if len(motion) < least * motion.rate:
        raise InputError(motion.name, f"{len(motion) / motion.rate:.2f} s", f"{least:g} s or more")
    rng = generator(seed)
    side = str(rng.choice(["l", "r"]))
    mount = Rotation.random(rng=rng)
    low_pass = butter(4, rng.uniform(*where.cutoff), fs=motion.rate, output="sos")
    position, attitude = _fixed(motion, where, side, place)
    if place == "in-front":
        ahead = smoothed(_ahead(motion), motion.rate, _HEADING_SIGMA)
        attitude = about_z(np.arctan2(ahead[:, 1], ahead[:, 0]))
        position = motion.position_W["chest"] + attitude.apply(where.offset)
    quat = np.asarray(composed(attitude, mount).as_quat())
    signs = np.cumprod(np.where(np.sum(quat[1:] * quat[:-1], axis=1) < 0.0, -1.0, 1.0))
    quat[1:] *= signs[:, None]
    hips = sosfiltfilt(butter(4, 6.0, fs=motion.rate, output="sos"), motion.position_W["hips"], 0)
    t = np.arange(len(motion)) / motion.rate
    time = np.arange(_TRIMMED, t[-1] - _TRIMMED, 1.0 / _RATE)
    known = make_interp_spline(t, sosfiltfilt(low_pass, position, axis=0), k=5)(time)
    turned = Rotation.from_quat(make_interp_spline(t, sosfiltfilt(low_pass, quat, axis=0))(time))
    strength = where.shaken * float(make_interp_spline(t, hips, k=5)(time, 2).std())
    strength *= rng.lognormal(0.0, 0.4)
    if place == "in-front":
        known = _on_an_arm(rng, known)
    offset, turn = _oscillation(rng, time, _landings(motion), strength, where.resonance)
    if place in ("ear", "in-front"):  # an arm is not the trunk
        turn += rng.uniform(0.03, 0.1) * drift(rng, len(time), _RATE, 0.4, 3)
    turned = composed(Rotation.from_rotvec(turn), turned)
    return Trajectory(time - time[0], known + offset, turned)


def _fixed(motion: BodyMotion, where: Place, side: str, what: str) -> tuple[FloatArray, Rotation]:
    """Return positions (N, 3) of a device fixed to a joint, and the joint's attitudes.

    It is placed by the body's own directions in the clip's middle, because the axes of joints
    differ from one source of motion capture to another.
    """
    limb = bool(where.towards)
    position, attitude = joint_of(motion, f"{side}_{where.joint}" if limb else where.joint, what)
    k = len(motion) // 2
    ahead = _ahead(motion)[k]
    left = np.cross([0.0, 0.0, 1.0], ahead)
    along = np.array([0.0, 0.0, 1.0])
    if limb:
        other, _ = joint_of(motion, f"{side}_{where.towards}", what)
        along = other[k] - position[k]
        # Ahead of a segment that hangs down, above one that is stretched out.
        ahead = np.cross(along, left) if where.joint in ("thigh", "forearm") else ahead
        ahead = ahead / np.linalg.norm(ahead) * np.sign(ahead @ _ahead(motion)[k] + 1e-9)
    outward = left if side == "l" else -left
    offset = where.offset @ np.stack([ahead, outward, along])
    return position + attitude.apply(attitude[k].apply(offset, inverse=True)), attitude


def _ahead(motion: BodyMotion) -> FloatArray:
    """Return the horizontal direction (N, 3) in which the pelvis faces."""
    left = motion.position_W["l_thigh"] - motion.position_W["r_thigh"]
    ahead = np.cross(left, [0.0, 0.0, 1.0])
    return np.asarray(ahead / np.linalg.norm(ahead, axis=1, keepdims=True))


def _on_an_arm(rng: np.random.Generator, position: FloatArray) -> FloatArray:
    """Return where a device is whose hand follows positions (N, 3) as a damped spring does.

    The arm swings up at the frequency of the steps, and passes little above its resonance.
    """
    omega, damping = 2.0 * np.pi * rng.uniform(2.5, 5.0), rng.uniform(0.2, 0.6)
    spring = [2.0 * damping * omega, omega**2]
    numerator, denominator = bilinear(spring, [1.0, *spring], fs=_RATE)
    # A spring follows a steady walk without lag: only what deviates from it is filtered.
    steady = np.linspace(position[0], position[-1], len(position))
    state = lfilter_zi(numerator, denominator)[:, None] * (position - steady)[0]
    return np.asarray(steady + lfilter(numerator, denominator, position - steady, 0, state)[0])


def _landings(motion: BodyMotion) -> FloatArray:
    """Return the times at which feet land [s] and the speeds at which they sank [m/s]: (M, 2)."""
    low_pass = butter(2, 8.0, fs=motion.rate, output="sos")
    found = []
    for side in "lr":
        height = sosfiltfilt(low_pass, motion.position_W[f"{side}_foot"][:, 2])
        sinking = -np.gradient(height, 1.0 / motion.rate)
        peaks, _ = find_peaks(sinking, _LANDING, distance=max(1, round(0.3 * motion.rate)))
        found.append(np.stack([peaks / motion.rate + 0.04, sinking[peaks]], axis=1))
    return np.concatenate(found)


def _oscillation(
    rng: np.random.Generator,
    time: FloatArray,
    landings: FloatArray,
    strength: float,
    resonances: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """Return offsets (N, 3) [m] and small rotations (N, 3) [rad] in W of a shaken device.

    A pulse at every landing, with some noise between, drives a damped oscillator. The acceleration
    of the offsets has a root mean square of `strength` [m/s^2].
    """
    n, pad = len(time), 200
    drive = 0.1 * rng.standard_normal((n + pad, 6))
    at = np.rint((landings[:, 0] - time[0]) * _RATE).astype(int)
    for index, speed in zip(at, landings[:, 1], strict=True):
        if 0 <= index < n:
            stray = rng.normal([-0.4, 0.0, 1.0, 0.0, 0.0, 0.0], [0.3, 0.3, 0.3, 0.6, 0.6, 0.6])
            drive[index] += 4.0 * speed * stray
    f = rfftfreq(n + pad, 1.0 / _RATE)[:, None]
    resonance, damping = rng.uniform(*resonances, 6), rng.uniform(0.15, 0.5, 6)
    ratio = f / resonance
    response = ratio**2 / (1.0 - ratio**2 + 2j * damping * ratio)  # none of the slow motion
    response = response * np.exp(-((0.6 * ratio) ** 2))
    acceleration = rfft(drive, axis=0) * response
    rms = np.sqrt(np.square(irfft(acceleration, n + pad, axis=0)[:n]).sum(axis=0) / n)
    size = strength / np.array([np.linalg.norm(rms[:3])] * 3 + [np.linalg.norm(rms[3:])] * 3)
    omega = 2.0 * np.pi * np.maximum(f, 1.0)
    offset = irfft(-acceleration[:, :3] * size[:3] / omega**2, n + pad, axis=0)[:n]
    turn = irfft(acceleration[:, 3:] * size[3:] * _ROTATED / (1j * omega), n + pad, axis=0)[:n]
    return offset, turn
