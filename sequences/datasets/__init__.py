"""Collections of recordings: lists, splits, caches, conversion."""
