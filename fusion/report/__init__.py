"""Reports of a run: a self-contained HTML file, and a file for the rerun viewer."""
