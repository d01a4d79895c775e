"""Judge virtual devices on motion capture by whole sets left out of the training.

For each set, one network learns from all others and one also from virtual devices on people in
motion capture; both are then judged on that set, by way of carrying:

    python examples/sets_left_out.py --data "$STARIO_DATA" --out runs/left-out

Trainings that are finished are kept, others resume. On a GPU, where one network's small kernels
leave most of it idle, train several at once (`--jobs 8`).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

SETS = ("tyrex", "ilc", "rocip", "ridi", "kipd", "rfbr")
RECIPE = {
    "epochs": 2, "epoch_windows": 120_000, "batch": 160, "rate": 7e-4, "dropout": 0.2,
    "likelihood_from": 0.0, "precision": "bfloat16", "patience": 100, "seed": 1,
}  # fmt: skip
REAL = {"ridi.h5": 0.2, "tyrex.h5": 0.22, "kipd.h5": 0.17, "rfbr.h5": 0.05}
VIRTUAL = {"cmu.h5": 0.15, "bandai.h5": 0.12}


def stario(*arguments: object) -> None:
    """Run a command of StarIO."""
    command = Path(sys.executable).with_name("stario")
    if code := subprocess.run([str(command), *map(str, arguments)]).returncode:
        sys.exit(code)  # the command has said why


def trained(data: Path, out: Path, task: tuple[str, bool]) -> None:
    """Train without a set, with or without virtual devices."""
    left_out, with_body = task
    folder = out / f"{left_out}-{'with' if with_body else 'without'}"
    if (folder / "model.safetensors").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    rest = 1.0 - sum(VIRTUAL.values())
    shares = {k: v * rest for k, v in REAL.items()} | VIRTUAL if with_body else REAL
    recipe = folder / "recipe.json"
    recipe.write_text(json.dumps({**RECIPE, "shares": {"simulated": 0.0, **shares}}))
    body = [word for name in VIRTUAL for word in ("--body", data / "body" / name)]
    stario(
        "train", "--data", data, "--leave-out", left_out, "--recorded-only", "--config", recipe,
        "--start-from", "walks-36min", "--out", folder, *(body if with_body else []),
    )  # fmt: skip


def judged(data: Path, out: Path, left_out: str) -> None:
    """Print errors, lengths and directions on the set, by way of carrying."""
    with_body, without = (out / f"{left_out}-{k}/model.safetensors" for k in ("with", "without"))
    stario(
        "evaluate", data / "archives" / f"{left_out}.h5", "--by", "carry",
        "--model", with_body, "--against", without,
    )  # fmt: skip


def main() -> None:
    """Train, then judge, set by set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/left-out"))
    parser.add_argument("--sets", nargs="+", default=SETS, choices=SETS)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    if options.data is None:
        print("trains for hours on the development recordings: name their folder, --data FOLDER")
        return
    if not options.data.is_dir() or options.jobs < 1:
        parser.exit(
            2, f"--data {options.data} --jobs {options.jobs}: expected a folder, 1 or more\n"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    tasks = [(left_out, body) for left_out in options.sets for body in (False, True)]
    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(partial(trained, options.data, options.out), tasks))
    for left_out in options.sets:
        judged(options.data, options.out, left_out)


if __name__ == "__main__":
    main()
