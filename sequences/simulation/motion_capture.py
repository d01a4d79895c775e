"""Motion capture of people: poses of the body's joints, from HDF5 clips or a BVH file.

An HDF5 file has a group per clip, `file.h5:clip`, with `position_first` (J, 3) and `position_step`
(N, J, 3), whose cumulated sum are positions in 0.1 mm with z up, `quaternion` (N, J, 4) in 1/32767,
xyzw, joint to world, and attributes `rate` [Hz] and `joints` (their names, one of `JOINTS` each).
"""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import shortlist
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.archive import archive_attributes, is_hdf5, opened_hdf5, split_name
from stario.sequences.sequence import FloatArray
from stario.sequences.simulation.bvh import Skeleton, read_skeleton

_LIMBS = ("thigh", "shin", "foot", "upperarm", "forearm", "hand")
JOINTS = ("hips", "chest", "head", *(f"{side}_{limb}" for limb in _LIMBS for side in "lr"))
"""Names of joints, each at the near end of its segment: a thigh at the hip, a hand at the wrist."""

_NEEDED = ("hips", "l_thigh", "r_thigh", "l_foot", "r_foot")

_EXPECTED = "an intact HDF5 file of motion capture"

_LEG = (0.65, 1.1)
"""Length of a leg of people [m]."""

_UNITS = (1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45)
"""Units of length in BVH files [m]; the last is that of the Carnegie Mellon database."""


@dataclass(frozen=True, eq=False, repr=False)
class BodyMotion:
    """Poses of a body's joints in a world frame W with z up.

    Attributes:
        name: name of the clip.
        rate: rate of the frames [Hz].
        position_W: joint -> (N, 3) [m].
        attitude_WJ: joint -> N rotations from the joint's frame to W; its axes may be any.
        attributes: what the source says, such as person and licence.
    """

    name: str
    rate: float
    position_W: dict[str, FloatArray]
    attitude_WJ: dict[str, Rotation]
    attributes: dict[str, str | float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.position_W["hips"])

    def __repr__(self) -> str:
        return f"BodyMotion({self.name}: {len(self)} frames at {self.rate:g} Hz)"


def body_clips(path: Path) -> list[Path]:
    """Return the clips of a motion capture file: `file.h5:clip` each, or a BVH file itself.

    Args:
        path: the file; `file.h5:clip`, where the clip's name may be a pattern such as `hdm05_*`.

    Raises:
        ReadError: the file cannot be read, or no clip has such a name.
    """
    file, clip = split_name(path)
    if not is_hdf5(file):
        return [path]
    with opened_hdf5(file, _EXPECTED) as content:
        names = fnmatch.filter(content, clip or "*")
        if not names:
            raise _no_such_clip(file, clip, list(content))
    return [Path(f"{file}:{name}") for name in names]


def read_body(path: Path) -> BodyMotion:
    """Read a clip of motion capture.

    Args:
        path: `file.h5:clip`, the file alone if it holds a single clip, or a BVH file.

    Raises:
        ReadError: the file or the clip does not exist, or its content is malformed.
    """
    file, clip = split_name(path)
    if not is_hdf5(file):
        return _from_skeleton(path, read_skeleton(path))
    if clip is None:
        clips = body_clips(file)
        if len(clips) != 1:
            fix = f"use {file.name}:{split_name(clips[0])[1]}" if clips else ""
            raise ReadError(file, "clip", f"{len(clips)} clips", "the name of one", fix)
        clip = split_name(clips[0])[1] or ""
    return _from_hdf5(file, clip)


def _no_such_clip(path: Path, clip: str | None, names: list[str]) -> ReadError:
    return ReadError(path, "clip", repr(clip), f"a name in it, such as {shortlist(names, 3)}")


def _from_hdf5(path: Path, clip: str) -> BodyMotion:
    with opened_hdf5(path, _EXPECTED) as file:
        if clip not in file:
            raise _no_such_clip(path, clip, list(file))
        group = file[clip]
        rate = float(group.attrs["rate"])
        names = [str(name) for name in group.attrs["joints"]]
        steps = np.cumsum(group["position_step"][:].astype(np.int64), axis=0)
        position = 1e-4 * (group["position_first"][:] + steps)
        quat_xyzw = group["quaternion"][:] / 32767.0
        if position.shape != (len(steps), len(names), 3) or quat_xyzw.shape[:2] != steps.shape[:2]:
            found = f"{position.shape} positions, {quat_xyzw.shape} quaternions"
            raise ReadError(path, clip, found, f"(N, {len(names)}, 3) and (N, {len(names)}, 4)")
        attitudes = [Rotation.from_quat(quat_xyzw[:, k]) for k in range(len(names))]
    _check_joints(path, names)
    attributes = archive_attributes(Path(f"{path}:{clip}"))
    del attributes["joints"], attributes["rate"]
    positions = {name: position[:, k] for k, name in enumerate(names)}
    return BodyMotion(clip, rate, positions, dict(zip(names, attitudes, strict=True)), attributes)


def _from_skeleton(path: Path, skeleton: Skeleton) -> BodyMotion:
    """Name a BVH file's joints, and bring it to metres with z up."""
    found = {name: k for name in JOINTS if (k := _joint_like(skeleton.names, name)) is not None}
    _check_joints(path, list(found))
    position, turns = skeleton.position, skeleton.attitude
    # People are upright: the axis along which hips are above feet points up.
    legs = position[:, [found["l_thigh"], found["r_thigh"]]]
    legs = legs - position[:, [found["l_foot"], found["r_foot"]]]
    up = int(np.argmax(np.abs(legs.mean(axis=(0, 1)))))
    length = float(np.linalg.norm(legs, axis=2).max())  # a knee may be bent
    unit = next((u for u in _UNITS if _LEG[0] <= u * length <= _LEG[1]), None)
    if unit is None:
        expected = "legs of a person in m, cm, mm, inches or units of the CMU database"
        raise ReadError(path, "HIERARCHY", f"legs {length:.3g} long", expected)
    # Cyclic, so that right-handed axes remain right-handed: y up becomes (z, x, y).
    order = np.roll(np.arange(3), 2 - up)
    to_z_up = Rotation.from_matrix(np.eye(3)[order])
    return BodyMotion(
        path.stem,
        1.0 / skeleton.step,
        {name: unit * position[:, k][:, order] for name, k in found.items()},
        {name: to_z_up * turns[k] for name, k in found.items()},
    )


_BVH_WORDS = {
    "hips": ("hips", "hip", "centerhip", "pelvis", "root"),
    "chest": ("spine2", "spine1", "chest", "thorax", "spine"),
    "head": ("head",),
    "thigh": ("upleg", "upperleg", "thigh", "femur", "hip"),
    "shin": ("lowerleg", "lowleg", "leg", "knee", "shin", "tibia", "calf"),
    "foot": ("foot", "ankle"),
    "upperarm": ("upperarm", "uparm", "arm", "humerus", "shoulder"),
    "forearm": ("forearm", "lowerarm", "lowarm", "elbow", "radius"),
    "hand": ("hand", "wrist"),
}
"""Names of joints in BVH files, by preference."""


def _joint_like(names: list[str], joint: str) -> int | None:
    """Return which of a file's names is that of a joint; None if none is."""
    side, _, limb = joint.rpartition("_")
    word = {"l": "left", "r": "right"}.get(side, "")
    plain = [name.rpartition(":")[2].lower().replace("joint_", "") for name in names]
    for known in _BVH_WORDS[limb]:
        spellings = {known} if not side else {
            f"{word}{known}", f"{word}_{known}", f"{known}_{side}", f"{known}_{word}",
            f"{side}_{known}", f"{side}{known}",
        }  # fmt: skip
        if (k := next((k for k, name in enumerate(plain) if name in spellings), None)) is not None:
            return k
    return None


def _check_joints(path: Path, names: list[str]) -> None:
    if missing := [name for name in _NEEDED if name not in names]:
        raise ReadError(path, "joints", f"no {', '.join(missing)}", "the joints of a person")


def joint_of(motion: BodyMotion, joint: str, what: str) -> tuple[FloatArray, Rotation]:
    """Return a joint's positions (N, 3) and attitudes; `what` needs it, for the error.

    Raises:
        InputError: the capture lacks the joint.
    """
    if joint not in motion.position_W:
        known = ", ".join(motion.position_W)
        raise InputError(what, f"{motion.name} has no {joint}", f"a place on one of {known}")
    return motion.position_W[joint], motion.attitude_WJ[joint]
