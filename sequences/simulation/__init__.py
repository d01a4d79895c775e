"""Simulated walks, and the IMU data of a device carried along them."""
