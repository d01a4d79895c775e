"""The paper's table: every network on every data set, run by run."""
