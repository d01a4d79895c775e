"""Compute a fused track of a recording: a CSV of your own needs only IMU columns.

python examples/run_recording.py [RECORDING]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from stario.fusion import Navigator, Track, demonstration
from stario.network import load_model
from stario.sequences import StarioError, read_recording, write_csv


def fused_track(path: Path) -> Track:
    """Read a recording in any supported format and fuse it."""
    return Navigator(load_model("default")).run(read_recording(path))


def main(path: Path | None = None) -> Track:
    """Fuse the recording, or a simulated one that is first written as a CSV."""
    if path is not None:
        return fused_track(path)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.csv"
        write_csv(path, demonstration().without_truth())
        return fused_track(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Compute a fused track of a recording.")
    parser.add_argument("recording", nargs="?", type=Path, help="default: a simulated one")
    try:
        track = main(parser.parse_args().recording)
    except StarioError as error:
        parser.exit(2, f"{error}\n")
    end = track.trajectory.position_W[-1]
    sigma = track.trajectory.position_covariance_W[-1].diagonal() ** 0.5
    seconds = track.time[-1] - track.time[0]
    print(f"after {seconds:.0f} s at {end.round(2)} m, sigma {sigma.round(2)} m")
    print("\n".join([*track.health.lines(), *track.health.notes]))
