"""Many recordings: lists, splits, caches, conversion."""
