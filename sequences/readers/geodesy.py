"""Metres east and north, for readers."""

from stario.sequences.geodesy import east_north as east_north
