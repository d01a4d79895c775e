"""BVH files (Biovision hierarchy): a skeleton and its angles, as joint poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.text import read_lines
from stario.sequences.sequence import FloatArray


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Poses of a BVH file's joints in its own axes and unit of length.

    Attributes:
        names: J names of joints, as in the file.
        step: time between frames [s].
        position: (N, J, 3).
        attitude: N rotations from each joint's frame to the file's axes.
    """

    names: list[str]
    step: float
    position: FloatArray
    attitude: list[Rotation]


@dataclass
class _Joint:
    name: str
    parent: int
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    channels: tuple[str, ...] = ()


def read_skeleton(path: Path) -> Skeleton:
    """Read a BVH file.

    Raises:
        ReadError: the file is missing or malformed.
    """
    lines = read_lines(path)
    start = next((k for k, line in enumerate(lines) if line.strip() == "MOTION"), None)
    if lines[0].strip() != "HIERARCHY" or start is None:
        raise ReadError(path, "file", "no HIERARCHY and MOTION", "a BVH file")
    try:
        joints = _joints(lines[1:start])
        count, step = (float(lines[start + k].rpartition(":")[2]) for k in (1, 2))
        values = np.array([line.split() for line in lines[start + 3 :] if line.strip()], float)
        if not (step > 0.0 and np.isfinite(values).all()):
            raise ValueError("a frame time or a value that is not a finite number")
        if values.shape != (wanted := (int(count), sum(len(j.channels) for j in joints))):
            raise ValueError(f"{values.shape} values, {wanted} expected")
        return _posed(joints, values, step)
    except (ValueError, IndexError, OverflowError) as error:
        raise ReadError(path, "content", str(error)[:200], "an intact BVH file") from error


def _joints(lines: list[str]) -> list[_Joint]:
    """Return the joints in the order of their channels, without end sites."""
    joints: list[_Joint] = []
    open_blocks: list[int | None] = []
    block: int | None = None
    for line in lines:
        word, *rest = line.split() or [""]
        if word in ("ROOT", "JOINT"):
            parent = next((k for k in reversed(open_blocks) if k is not None), -1)
            block = len(joints)
            joints.append(_Joint(" ".join(rest), parent))
        elif word == "End":
            block = None
        elif word == "{":
            open_blocks.append(block)
        elif word == "}":
            open_blocks.pop()
        elif open_blocks and open_blocks[-1] is not None:
            if word == "OFFSET":
                joints[open_blocks[-1]].offset = tuple(map(float, rest[:3]))
            elif word == "CHANNELS":
                joints[open_blocks[-1]].channels = tuple(c.lower() for c in rest[1:])
    return joints


def _posed(joints: list[_Joint], values: FloatArray, step: float) -> Skeleton:
    position = np.empty((len(values), len(joints), 3))
    attitude: list[Rotation] = []
    column = 0
    for k, joint in enumerate(joints):
        offset = np.tile(joint.offset, (len(values), 1))
        angles, axes = [], ""
        for channel in joint.channels:
            if channel.endswith("position"):  # replaces the offset
                offset[:, "xyz".index(channel[0])] = values[:, column]
            else:
                axes += channel[0].upper()
                angles.append(values[:, column])
            column += 1
        local = Rotation.identity(len(values))
        if axes:
            radians = np.radians(np.stack(angles, axis=1))
            local = Rotation.from_euler(axes, radians if len(axes) > 1 else radians[:, 0])
        if joint.parent < 0:
            position[:, k] = offset
            attitude.append(local)
        else:
            above = attitude[joint.parent]
            position[:, k] = position[:, joint.parent] + above.apply(offset)
            attitude.append(above * local)
    if not joints or not math.isfinite(float(position.sum())):
        raise ValueError("no joints with finite positions")
    return Skeleton([joint.name for joint in joints], step, position, attitude)
