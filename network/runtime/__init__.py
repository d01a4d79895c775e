"""What computes a trained network, and what that costs."""
