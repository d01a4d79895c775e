"""Tracks side by side, their errors in tables and figures, faults, consistency and speed."""
