"""The paper's table: every network on every data set, cell by cell."""
