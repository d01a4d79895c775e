"""How a recording's truth fits its IMU: clocks, axes, mounts."""
