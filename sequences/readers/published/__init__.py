"""Published data sets in their own form."""
