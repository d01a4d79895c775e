"""What `stario check` runs."""
