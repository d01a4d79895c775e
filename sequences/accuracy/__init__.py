"""Errors of a track against the ground truth, and consistency of its covariance."""
