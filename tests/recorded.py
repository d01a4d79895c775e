"""Folders of real recordings and of inputs that failed; without them their tests are skipped."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("STARIO_DATA") or ROOT.parent / "shared" / "data")
CASES = DATA.parent / "cases"
