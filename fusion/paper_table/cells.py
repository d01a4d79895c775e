"""One cell of the table: a network on a data set with a seed, filled once and kept as files.

`<out>/<set>/<network>/<n>-steps/seed-<n>/` holds the model and `trained.json` once training is
done, then `errors.json` and `tracks.npz`. Filling a cell again adds only what is missing.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from time import process_time

import numpy as np

from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning
from stario.fusion.paper_table.errors import Model, Shown, test_errors
from stario.fusion.paper_table.sets import ALL, DataSet
from stario.fusion.paper_table.training import (
    TEMPORARY_FILES,
    ReaderConfig,
    recipe_digest,
    recording_state,
    train_cell,
)
from stario.network.architectures import ARCHITECTURES
from stario.network.model import load_model
from stario.network.training.config import TrainingConfig
from stario.sequences.errors import ConfigError, ReadError
from stario.sequences.files import write_json, write_npz

LEADING = ("StarIO", "R-ResNet", "DeepILS", "StarIO without MSGCU")
"""Networks that are filled first, and with several seeds."""


@dataclass(frozen=True)
class Cell:
    """Definition of a cell, as plain values that can be sent to any machine.

    Attributes:
        dataset: data set, with the recordings of each part.
        network: architecture to train, or `pdr`, or weights as `load_model` accepts them.
        seed: seed of the training.
        recipe: training recipe; None where nothing is trained.
    """

    dataset: DataSet
    network: str
    seed: int
    recipe: TrainingConfig | None

    def __str__(self) -> str:
        return f"{self.dataset.name}, {self.network}, seed {self.seed}"

    def folder(self, out: Path) -> Path:
        """Return its folder below `out`; each number of training steps has a folder of its own."""
        above = out / self.dataset.name / self.network.replace("/", "_")
        if self.recipe is None:
            return above
        return above / f"{self.recipe.steps}-steps" / f"seed-{self.seed}"

    @property
    def digest(self) -> str:
        """Digest of everything that its results depend on except the code."""
        test = [recording_state(entry.path) for entry in self.dataset.test]
        if self.recipe is None:
            learned = "" if self.network == PDR else _weights_sha256(self.network)
        else:
            learned = recipe_digest(self.recipe, self.dataset)
        return hashlib.sha256(json.dumps([self.network, learned, test]).encode()).hexdigest()


@cache
def _weights_sha256(name: str) -> str:
    return load_model(name).card.sha256


def reference_rows(dataset: DataSet) -> tuple[str, ...]:
    """Return the references that are compared with the networks trained on a set.

    The default weights were trained on the groups that `ALL` holds out; the first-stage weights,
    of the same architecture, were not.
    """
    return (PDR, "first-stage") if dataset.name == ALL else (PDR, "default")


def fill_cell(cell: Cell, out: Path, reading: ReaderConfig) -> Cell:
    """Train and evaluate a cell, except for what is already done.

    Raises:
        ConfigError: existing results were made with another recipe, other weights or other
            recordings.
        InputError: the network cannot be trained.
    """
    folder = cell.folder(out)
    if _read_if_done(cell, folder / "errors.json") is None:
        folder.mkdir(parents=True, exist_ok=True)
        recipe = cell.recipe
        if recipe is not None and _read_if_done(cell, folder / "trained.json") is None:
            _train(cell, recipe, folder, reading)
        _evaluate(cell, folder, reading)
    return cell


def read_cell(cell: Cell, out: Path) -> dict[str, object] | None:
    """Return the content of a cell's `errors.json` and `trained.json`; None if it is not filled.

    Raises:
        ConfigError: it was filled with another recipe, other weights or other recordings.
    """
    folder = cell.folder(out)
    content = _read_if_done(cell, folder / "errors.json")
    if content is None or cell.recipe is None:
        return content
    return content | {"trained": _read(folder / "trained.json")}


def read_tracks(cell: Cell, out: Path) -> dict[str, Shown]:
    """Return the tracks of some recordings, by recording name."""
    path = cell.folder(out) / "tracks.npz"
    if not path.exists():
        return {}
    with np.load(path, allow_pickle=False) as arrays:
        names = list(dict.fromkeys(key.rsplit("|", 1)[0] for key in arrays.files))
        return {name: Shown(*(arrays[f"{name}|{part}"] for part in _PARTS)) for name in names}


_PARTS = ("time", "position_W", "truth_W")


def _train(cell: Cell, recipe: TrainingConfig, folder: Path, reading: ReaderConfig) -> None:
    content = train_cell(cell.dataset, recipe, folder, reading)
    write_json(folder / "trained.json", {"cell": cell.digest, **content})
    for spare in TEMPORARY_FILES:
        (folder / spare).unlink(missing_ok=True)


def _evaluate(cell: Cell, folder: Path, reading: ReaderConfig) -> None:
    began = process_time()
    model = _model(cell, folder)
    found, shown, skipped = test_errors(model, cell.dataset.test, reading)
    arrays = {f"{name}|{part}": getattr(t, part) for name, t in shown.items() for part in _PARTS}
    if arrays:
        write_npz(folder / "tracks.npz", **arrays)
    content = {
        "cell": cell.digest,
        "network": cell.network,
        "seed": cell.seed,
        "seconds": process_time() - began,
        "recordings": found,
        "skipped": [asdict(failure) for failure in skipped],
    }
    write_json(folder / "errors.json", content)


def _model(cell: Cell, folder: Path) -> Model:
    if cell.network == PDR:
        return PedestrianDeadReckoning()
    if cell.network in ARCHITECTURES:
        return load_model(folder / "model.safetensors")
    return load_model(cell.network)


def _read_if_done(cell: Cell, path: Path) -> dict[str, object] | None:
    content = _read(path) if path.exists() else None
    if content is not None and content.get("cell") != cell.digest:
        raise ConfigError(
            str(path),
            "made with another recipe, other weights, or recordings that differ or changed since",
            "those of this table",
            "use what it was made with, remove it to make it anew, or use another folder (--out)",
        )
    return content


def _read(path: Path) -> dict[str, object]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReadError(path, "file", str(error), "a complete JSON file") from error
    assert isinstance(content, dict)  # written only by this module
    return content
