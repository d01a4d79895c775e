"""Checks that `stario check` runs."""
