"""Values of the estimator: states and tracks, settings, fixes, floors, health, rotations."""
