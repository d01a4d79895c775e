"""Folder of the real recordings; tests that need one are skipped if it is missing."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("STARIO_DATA") or ROOT.parent / "shared" / "data")
