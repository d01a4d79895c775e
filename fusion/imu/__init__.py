"""The front end: check raw samples, cut them into intervals and preintegrate them."""
