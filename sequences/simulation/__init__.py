"""Simulated walks and the IMU that would have been carried along them."""
