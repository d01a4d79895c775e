"""Inspection of a recording from its own data: units, rest, magnetic field."""
