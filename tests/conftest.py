"""Environment of all tests."""

import os

# Two workers share the cores, and small matrices need one thread. Set before NumPy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
