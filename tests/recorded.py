"""Where the real recordings are; tests on them skip where there are none."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("STARIO_DATA") or ROOT.parent / "shared" / "data")
