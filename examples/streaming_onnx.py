"""Stream on ONNX Runtime alone, as on a small computer: PyTorch is never imported.

Export the model once, on any computer: stario export --out model.onnx. Without a file, the example
runs that command in a separate process. Needs `pip install 'stario[onnx]'`.

    python examples/streaming_onnx.py [MODEL.onnx]
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any


def stream(path: Path, seconds: float) -> tuple[list[Any], float]:
    """Stream the demonstration; return its states and the time to import and load [s]."""
    began = perf_counter()
    from stario.fusion import Navigator, demonstration
    from stario.network import load_model

    navigator = Navigator(load_model(path))
    loading = perf_counter() - began
    recording = demonstration()
    states = []
    for time, gyro, accel in zip(recording.time, recording.gyro, recording.accel, strict=True):
        if time > seconds:
            break
        state = navigator.push(time, gyro, accel)
        if state is not None:
            states.append(state)
    return states, loading


def exported(folder: Path) -> Path:
    """Export the default weights to an ONNX file."""
    path = folder / "default.onnx"
    code = "from stario.fusion.commands.cli import main; main()"
    subprocess.run([sys.executable, "-c", code, "export", "--out", str(path)], check=True)
    return path


def main(path: Path | None = None, seconds: float = 20.0) -> dict[str, Any]:
    """Stream with an exported model; return the last position, and the time and memory needed."""
    with tempfile.TemporaryDirectory() as folder:
        states, loading = stream(path or exported(Path(folder)), seconds)
    return {
        "p_W": states[-1].p_W.tolist(),
        "states": len(states),
        "seconds_loading": round(loading, 2),
        "memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "torch_imported": "torch" in sys.modules,
    }


if __name__ == "__main__":
    print(main(Path(sys.argv[1]) if len(sys.argv) > 1 else None))
