"""A walk that is watched while it happens: samples come in, tracks are drawn as they grow."""
