"""Fit of a recording's ground truth to its IMU: clocks, axes, mounts."""
