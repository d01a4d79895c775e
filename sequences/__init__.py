"""Recordings: sequences, readers, simulation, windows, metrics and figures."""

from stario.sequences.lazy import public_names

__all__, __getattr__, __dir__ = public_names("stario.sequences")
