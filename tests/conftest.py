"""Environment of all tests."""

import os

# Two workers share the cores, and small matrices need one thread. Set before NumPy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from hypothesis import settings

# The same examples in every run; `--hypothesis-profile default` looks for others.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")
