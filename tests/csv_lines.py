from pathlib import Path

ROW = "0.1,0.2,0.3,1.0,2.0,9.0"
"""Cells of an IMU sample: rates [rad/s], then forces [m/s^2]."""


def write_lines(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path
