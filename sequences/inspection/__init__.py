"""What a recording says of itself: units, rest, magnetic field."""
