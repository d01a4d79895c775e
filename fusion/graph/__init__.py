"""The factor graph: keyframes, factors, batch and fixed lag."""
