"""Attitude from the IMU: rotations, levelling."""
