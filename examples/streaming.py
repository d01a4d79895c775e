"""Call StarIO from navigation code: push samples as they arrive, read each state returned.

python examples/streaming.py
"""

from __future__ import annotations

import argparse

from stario.fusion import Navigator, NavState, demonstration
from stario.network import load_model


def main(seconds: float = 30.0) -> list[NavState]:
    """Feed a simulated phone's samples one by one, as a driver's callback would."""
    recording = demonstration()
    navigator = Navigator(load_model("default"))
    states = []
    for time, gyro, accel in zip(recording.time, recording.gyro, recording.accel, strict=True):
        state = navigator.push(time, gyro, accel)
        if state is not None:
            states.append(state)
        if time > seconds:
            break
    return states


if __name__ == "__main__":
    argparse.ArgumentParser(description="Push the demonstration's samples one by one.").parse_args()
    for state in main()[::50]:
        sigma = state.position_covariance.diagonal() ** 0.5
        print(f"t {state.time:6.2f} s  p_W {state.p_W.round(2)} m  sigma {sigma.round(2)} m")
