"""Benchmark of networks alone, by groups of recordings."""
