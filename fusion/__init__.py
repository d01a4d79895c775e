"""What we conclude: preintegration, filter, navigator, tracks, command."""
