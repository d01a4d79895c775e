"""Train on your own recordings: anything `read_recording` reads that has ground truth.

A real run takes hours of recordings and many epochs; `stario train` does the same with a progress
bar. This one is small enough to watch.

    python examples/train_own.py
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from stario.network import DisplacementModel, TrainingConfig, TrainingData, load_model, train
from stario.sequences import generate_walk, simulate_imu, world_streams


def main(folder: Path, epochs: int = 2) -> DisplacementModel:
    """Train on five simulated recordings, validate on a sixth, and load the result."""
    recordings = [simulate_imu(generate_walk(seed, 30.0), 200.0, seed=seed) for seed in range(6)]
    streams = [stream for recording in recordings for stream in world_streams(recording)]
    config = TrainingConfig(epochs=epochs, epoch_windows=256, batch=64, seed=0)
    weights = train(config, TrainingData(streams[:-1]), TrainingData(streams[-1:]), folder)
    return load_model(weights)


if __name__ == "__main__":
    argparse.ArgumentParser(description="Train on six simulated recordings.").parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        model = main(Path(temporary))
    print(model.card.figures)
