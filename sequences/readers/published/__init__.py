"""Published data sets in their original formats."""
