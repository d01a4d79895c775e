"""Sensor fusion: preintegration, EKF and factor graph, navigator, evaluation, command line."""

from stario.sequences.lazy import public_names

__all__, __getattr__, __dir__ = public_names("stario.fusion")
