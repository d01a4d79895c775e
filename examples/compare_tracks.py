"""Compare tracks of one recording with the ground truth: IMU alone, network alone, filter.

python examples/compare_tracks.py
"""

from __future__ import annotations

import argparse

from stario.fusion import Comparison, compare
from stario.network import load_model
from stario.sequences import PHONE_IMU, WalkStyle, generate_walk, simulate_imu


def main(seconds: float = 60.0) -> Comparison:
    """Simulate a walk with the phone in a pocket and compare all tracks of the walk."""
    style = WalkStyle(carry="pocket", preferred_speed=1.3)
    walk = generate_walk(seed=3, duration=seconds, style=style)
    recording = simulate_imu(walk, 100.0, PHONE_IMU, seed=7, name="pocket")
    return compare(load_model("default"), recording)


if __name__ == "__main__":
    argparse.ArgumentParser(description="Compare tracks of a simulated walk.").parse_args()
    comparison = main()
    for name, metrics in comparison.metrics.items():
        print(f"{name:<24} horizontal ATE {metrics['ate_m']:.2f} m")
