"""What all tests run under."""

import os

# Two workers share the cores, and small matrices like one thread; before NumPy reads it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
