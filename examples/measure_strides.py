"""Measure how people move a device within a stride, for `stario simulate`.

Reads archives (`data/archives`), whose attribute `carry` says how the device was carried, and
writes the mean strides that `sequences/simulation/strides.npz` holds:

    python examples/measure_strides.py "$STARIO_DATA/archives" strides.npz

Recordings without true attitudes (Indoor Location) are along the network's track, scaled by the
waypoints. Without arguments it measures one of the simulated walks that come from the file.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, network_track
from stario.network import load_model
from stario.sequences import (
    ImuSequence,
    StarioError,
    StrideCycle,
    Trajectory,
    WalkStyle,
    generate_walk,
    measured_stride,
    on_one_side,
    read_recording,
    simulate_imu,
)

WAYS = {
    "kipd.h5": {"handheld": "handheld"},
    "rfbr.h5": {"handheld": "handheld"},
    "ridi.h5": {"handheld": "texting", "pocket (leg)": "pocket", "bag": "bag"},
    "tyrex.h5": {
        "handheld (texting)": "texting", "handheld (at the ear)": "call", "swinging": "swinging",
        "pocket (front)": "pocket", "pocket (back)": "back-pocket",
    },
    "ilc.h5": {"handheld (flat in front)": "in-front"},
}  # fmt: skip
"""The simulator's ways of carrying, by archive and its attribute."""

MOST = 16
"""Most recordings of a way from one archive."""


def recordings(folder: Path) -> Iterator[tuple[str, ImuSequence]]:
    """Yield ways of carrying and recordings, of each archive's ways the longest ones."""
    for name, ways in WAYS.items():
        found = defaultdict(list)
        with h5py.File(folder / name) as archive:
            for key, group in archive.items():
                if way := ways.get(str(group.attrs["carry"])):
                    found[way].append((-float(group.attrs["metres"]), key))
        for way, keys in found.items():
            for _, key in sorted(keys)[:MOST]:
                yield way, read_recording(folder / f"{name}:{key}")


def poses_of(sequence: ImuSequence) -> Trajectory:
    """Return true poses, or those along the network's track with the waypoints' length."""
    if sequence.truth is not None:
        return sequence.truth
    # At twenty updates a second: between the attitudes of two, a hand's turning would be lost.
    config = NavigatorConfig(filter=FilterConfig(update_rate=20))
    navigator = Navigator(load_model("default"), config)
    track = network_track(navigator.observe(sequence)).trajectory
    if sequence.positions is None:
        return track
    at = sequence.positions.time.clip(*track.time[[0, -1]])
    paths = (sequence.positions.position_W[:, :2], track.at(at).position_W[:, :2])
    true, found = (np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths)
    return replace(track, position_W=track.position_W * true / found)


def measure(folder: Path, out: Path) -> None:
    """Measure the people of the archives in a folder and write their strides."""
    people = defaultdict(list)
    for way, sequence in recordings(folder):
        if stride := measured_stride(sequence, poses_of(sequence)):
            people[way].append(stride)
            print(f"{way:12} {sequence.name:40} {stride.speed:.2f} m/s, {stride.step_rate:.2f} Hz")
    alike = [(way, each) for way, found in people.items() for each in on_one_side(found)]
    amplitude = np.array([stride.amplitude for _, stride in alike])
    np.savez_compressed(
        out,
        way=[way for way, _ in alike],
        speed=np.float32([stride.speed for _, stride in alike]),
        step_rate=np.float32([stride.step_rate for _, stride in alike]),
        quat_xyzw=np.float32([stride.quat_xyzw for _, stride in alike]),
        amplitude=np.stack([amplitude.real, amplitude.imag], axis=-1).astype(np.float16),
    )


def main(seconds: float = 60.0) -> StrideCycle | None:
    """Measure the stride of a simulated walk."""
    walk = simulate_imu(generate_walk(1, seconds, style=WalkStyle(carry="pocket")), 100.0)
    stride = measured_stride(walk, poses_of(walk))
    if stride:
        print(
            f"a simulated walk: {stride.step_rate:.2f} steps per second at {stride.speed:.2f} m/s"
        )
    return stride


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("archives", nargs="?", type=Path)
    parser.add_argument("out", nargs="?", type=Path, default=Path("strides.npz"))
    arguments = parser.parse_args()
    try:
        measure(arguments.archives, arguments.out) if arguments.archives else main()
    except (StarioError, OSError) as error:
        parser.exit(2, f"{error}\n")
