from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import PERFECT_IMU, STANDARD_GRAVITY, InputError, ReadError
from stario.sequences.simulation.body import PLACES, carried_on, places_on, virtual_imu
from stario.sequences.simulation.motion_capture import BodyMotion, body_clips, read_body

SPEED, STEP_RATE, RATE, SECONDS = 1.2, 1.8, 60.0, 6.0
_REST = {
    "hips": (0.0, 0.0, 0.95), "chest": (0.0, 0.0, 1.3), "head": (0.0, 0.0, 1.55),
    "thigh": (0.0, 0.1, 0.9), "shin": (0.0, 0.1, 0.48), "foot": (0.0, 0.1, 0.08),
    "upperarm": (0.0, 0.2, 1.4), "forearm": (0.0, 0.22, 1.1), "hand": (0.0, 0.22, 0.85),
}  # fmt: skip


def walker(yaw: float = 0.0, speed: float = SPEED) -> BodyMotion:
    """A person who walks along a heading; legs and arms swing about hips and shoulders."""
    t = np.arange(round(SECONDS * RATE)) / RATE
    position, attitude = {}, {}
    R_WH = Rotation.from_euler("z", yaw)
    bounce = np.outer(0.02 * np.cos(2 * np.pi * STEP_RATE * t), [0, 0, 1])
    moved = np.outer(speed * t, [1, 0, 0]) + bounce
    for name, rest in _REST.items():
        limb = name not in ("hips", "chest", "head")
        for side, sign in (("l_", 1.0), ("r_", -1.0)) if limb else (("", 0.0),):
            phase = sign * (1.0 if name in ("thigh", "shin", "foot") else -1.0)
            swing = -0.4 * phase * np.sin(np.pi * STEP_RATE * t) if limb else 0.0 * t
            pivot = np.array([0.0, 0.1 * sign, 0.9 if name in ("thigh", "shin", "foot") else 1.4])
            at = np.array(rest) * [1.0, sign if limb else 1.0, 1.0]
            R_HJ = Rotation.from_euler("y", swing[:, None])
            position[side + name] = R_WH.apply(pivot + R_HJ.apply(at - pivot) + moved)
            attitude[side + name] = R_WH * R_HJ
    return BodyMotion("walker", RATE, position, attitude, {"licence": "none needed"})


def write_hdf5(path: Path, motion: BodyMotion) -> None:
    names = list(motion.position_W)
    position = np.stack([motion.position_W[n] for n in names], axis=1)
    units = np.rint(1e4 * position).astype(np.int64)
    quat = np.stack([motion.attitude_WJ[n].as_quat() for n in names], axis=1)
    with h5py.File(path, "w") as file:
        group = file.create_group(motion.name)
        group["position_first"] = units[0].astype(np.int32)
        group["position_step"] = np.diff(units, axis=0, prepend=units[:1]).astype(np.int16)
        group["quaternion"] = np.rint(32767 * quat).astype(np.int16)
        group.attrs.update({"rate": motion.rate, "licence": "none needed"})
        group.attrs["joints"] = names


def strapdown_error(sequence: object) -> float:
    """Largest difference between truth and what integration of perfect samples gives [m]."""
    truth, t = sequence.truth, sequence.time
    force_W = truth.attitude_WB.apply(sequence.accel)
    acceleration = force_W - [0.0, 0.0, STANDARD_GRAVITY]
    steps = np.diff(t)[:, None]
    velocity = truth.velocity_W[0] + np.cumsum(
        np.vstack([np.zeros(3), 0.5 * steps * (acceleration[1:] + acceleration[:-1])]), axis=0
    )
    position = truth.position_W[0] + np.cumsum(
        np.vstack([np.zeros(3), 0.5 * steps * (velocity[1:] + velocity[:-1])]), axis=0
    )
    return float(np.linalg.norm(position - truth.position_W, axis=1).max())


@pytest.mark.parametrize("place", PLACES)
def test_samples_and_truth_of_every_place_agree(place):
    device = virtual_imu(walker(), place, 200.0, PERFECT_IMU, seed=3)

    assert strapdown_error(device) < 2e-3
    moved = device.truth.position_W[-1] - device.truth.position_W[0]
    assert abs(moved[0] / device.duration - SPEED) < 0.2  # a limb may end in another phase
    assert device.attributes == {"licence": "none needed", "carry": place}


def test_heading_of_the_person_turns_the_track_and_changes_no_sample():
    ahead = virtual_imu(walker(), "front-pocket", errors=PERFECT_IMU, seed=1)
    left = virtual_imu(walker(yaw=np.pi / 2), "front-pocket", errors=PERFECT_IMU, seed=1)

    turned = Rotation.from_euler("z", np.pi / 2).apply(ahead.truth.position_W)
    # The oscillation is drawn in W: only what the capture knows is the same.
    assert (
        np.abs(left.truth.position_W - left.truth.position_W[0] - turned + turned[0]).max() < 5e-3
    )


def test_a_pocket_is_ahead_of_the_thigh_and_the_ear_beside_the_head():
    motion = walker(speed=0.0)
    thigh = motion.position_W["l_thigh"].mean(axis=0)
    pockets = [carried_on(motion, "front-pocket", k).position_W.mean(axis=0) for k in range(6)]
    ears = [carried_on(motion, "ear", k).position_W.mean(axis=0) for k in range(6)]

    assert all(p[0] > thigh[0] + 0.05 and 0.6 < p[2] < 0.9 for p in pockets)
    assert {round(float(p[1]), 1) for p in ears} == {-0.1, 0.1}  # either side


def test_landing_feet_shake_a_pocket_more_than_a_hand():
    def high(place):
        device = virtual_imu(walker(), place, 100.0, PERFECT_IMU, seed=5)
        force = np.linalg.norm(device.accel, axis=1)
        spectrum = np.abs(np.fft.rfft((force - force.mean()) * np.hanning(len(force)))) ** 2
        f = np.fft.rfftfreq(len(force), 0.01)
        return float(np.sqrt(8.0 / 3.0 * 2.0 * spectrum[(f > 9) & (f < 20)].sum()) / len(force))

    assert high("front-pocket") > 2.0 * high("in-front") > 0.0


def test_seed_decides_everything():
    one, same, other = (virtual_imu(walker(), "bag", seed=k) for k in (1, 1, 2))
    assert np.array_equal(one.accel, same.accel)
    assert not np.allclose(one.accel, other.accel, atol=0.1)


def test_hdf5_clip_is_read(tmp_path):
    motion = walker(yaw=0.3)
    write_hdf5(tmp_path / "body.h5", motion)

    read = read_body(body_clips(tmp_path / "body.h5")[0])
    assert read.attributes == {"licence": "none needed"}
    assert read.rate == RATE
    for name in motion.position_W:
        assert np.abs(read.position_W[name] - motion.position_W[name]).max() < 1e-4
        assert (read.attitude_WJ[name].inv() * motion.attitude_WJ[name]).magnitude().max() < 1e-3


def test_clips_are_named_by_a_pattern(tmp_path):
    file = tmp_path / "body.h5"
    write_hdf5(file, walker())
    assert body_clips(Path(f"{file}:walk*")) == body_clips(file)
    for read, clip in ((body_clips, "run*"), (read_body, "runner")):
        with pytest.raises(ReadError, match="walker"):
            read(Path(f"{file}:{clip}"))


BVH = """HIERARCHY
ROOT Hips
{{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
{legs} JOINT Head
 {{
  OFFSET 0 60 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  End Site
  {{
   OFFSET 0 20 0
  }}
 }}
}}
MOTION
Frames: {count}
Frame Time: 0.02
{rows}
"""
_LEG = """ JOINT {side}UpLeg
 {{
  OFFSET {x} -5 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  JOINT {side}Leg
  {{
   OFFSET 0 -42 0
   CHANNELS 3 Zrotation Xrotation Yrotation
   JOINT {side}Foot
   {{
    OFFSET 0 -42 0
    CHANNELS 3 Zrotation Xrotation Yrotation
   }}
  }}
 }}
"""


def write_bvh(path: Path, scale: float = 1.0) -> None:
    """A person in centimetres, y up, who faces z and walks towards it at 1 m/s; knee bent 90."""
    legs = _LEG.format(side="Left", x=10) + _LEG.format(side="Right", x=-10)
    knee = "0 0 0  0 90 0  0 0 0"  # of thigh, shin, foot: Z X Y
    rows = [f"0 95 {2.0 * k}  0 0 0  {knee}  0 0 0 0 0 0 0 0 0  0 0 0" for k in range(200)]
    text = BVH.format(legs=legs, count=len(rows), rows="\n".join(rows))
    path.write_text(text.replace("-42", f"{-42 * scale:g}"))


def test_bvh_is_brought_to_metres_with_z_up(tmp_path):
    write_bvh(tmp_path / "walk.bvh")
    motion = read_body(tmp_path / "walk.bvh")

    hips, left = motion.position_W["hips"], motion.position_W["l_thigh"]
    assert np.allclose(hips[:, 2], 0.95)
    walked = hips[-1] - hips[0]
    assert np.allclose(np.linalg.norm(walked), 199 * 0.02)
    # Left is left of the direction walked.
    assert np.allclose(np.cross(walked / np.linalg.norm(walked), left[0] - hips[0])[2], 0.1)
    # The left knee is bent: its foot is 0.42 m behind, at the height of the knee.
    behind = motion.position_W["l_foot"][0] - motion.position_W["l_shin"][0]
    assert np.allclose(behind @ walked / np.linalg.norm(walked), -0.42)
    assert set(places_on(motion)) == {"front-pocket", "back-pocket", "belt", "ear", "head", "foot"}


def test_a_bvh_that_is_damaged_or_of_no_known_unit_is_refused(tmp_path):
    write_bvh(tmp_path / "giant.bvh", scale=5.0)
    with pytest.raises(ReadError, match="legs 420 long"):
        read_body(tmp_path / "giant.bvh")
    (tmp_path / "cut.bvh").write_text((tmp_path / "giant.bvh").read_text()[:-40])
    with pytest.raises(ReadError, match=r"cut\.bvh"):
        read_body(tmp_path / "cut.bvh")


def test_a_place_without_its_joint_is_refused():
    motion = walker()
    del motion.position_W["head"]
    with pytest.raises(InputError, match="has no head"):
        virtual_imu(motion, "ear")
    with pytest.raises(InputError, match="front-pocket"):
        virtual_imu(motion, "sock")
