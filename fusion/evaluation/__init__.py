"""Comparison of tracks: errors, tables, figures, and checks of faults, consistency and speed."""
