"""The state-cloning EKF and what surrounds it."""
