"""Inference with trained networks, and its cost."""
