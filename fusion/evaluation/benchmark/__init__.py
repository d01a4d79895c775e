"""Judging: evaluation of networks alone, by groups of recordings."""
