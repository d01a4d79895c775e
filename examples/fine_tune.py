"""Fine-tune the default weights on your own walks, with waypoints as the only ground truth.

The command does the same: write `t,gx,gy,gz,ax,ay,az,px,py` to a CSV, with the last two where you
passed a known point (or had a satellite fix) and blank elsewhere, and run

    stario train my_walks/ --start-from default --out runs/mine

    python examples/fine_tune.py
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from stario.network import DisplacementModel, TrainingConfig, TrainingData, load_model, train
from stario.sequences import (
    ImuSequence,
    PositionTrack,
    generate_walk,
    leg_streams,
    simulate_imu,
    world_streams,
)


def walk_with_waypoints(seed: int) -> ImuSequence:
    """Simulate a recording with a known position every four seconds and no known attitude."""
    walk = generate_walk(seed, 40.0)
    time = np.arange(1.0, 39.0, 4.0)
    waypoints = PositionTrack(time, walk.at(time).position_W[:, :2], "waypoints")
    return replace(simulate_imu(walk, 100.0, seed=seed), truth=None, positions=waypoints)


def main(folder: Path, epochs: int = 1) -> DisplacementModel:
    """Train a few steps on three walks; most of the result is the initial weights'."""
    legs = [stream for seed in range(3) for stream in leg_streams(walk_with_waypoints(seed))]
    full = [world_streams(simulate_imu(generate_walk(seed, 30.0), seed=seed)) for seed in (7, 8)]
    config = TrainingConfig(
        epochs=epochs, epoch_windows=64, batch=32, rate=1e-4, learned=0.3, likelihood_from=0.0,
        waypoint_stretches=2, waypoint_seconds=12,
    )  # fmt: skip
    before = load_model("default")
    weights = train(
        config, TrainingData(full[0], legs=legs), TrainingData(full[1]), folder,
        start_from=before, calibration=before.card.calibration,
    )  # fmt: skip
    return load_model(weights)


if __name__ == "__main__":
    argparse.ArgumentParser(description="Fine-tune on three simulated walks.").parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        print(main(Path(temporary)).card.figures)
