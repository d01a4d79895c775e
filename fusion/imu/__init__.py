"""The front end: raw samples checked, cut into intervals and preintegrated."""
