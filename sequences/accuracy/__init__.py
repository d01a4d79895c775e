"""How far a track is from the truth, and how honest its covariance."""
