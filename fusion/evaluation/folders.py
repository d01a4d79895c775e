"""Folders of results: created where missing, and never a mixture of two runs."""

from __future__ import annotations

import os
from itertools import product
from pathlib import Path

from stario.fusion.evaluation.compare import TRACKS
from stario.sequences.errors import InputError

_FIGURES = ("plan.png", "error.png", "innovations.png", "report.html")

RESULTS = {
    "metrics.json": ("config.json", "run.json"),
    "health.json": (*_FIGURES, "track.rrd", "ekf.tum", "ekf.npz", "graph.tum", "graph.npz"),
    "inertial.npz": (
        *(*_FIGURES, "truth.tum"),
        *(f"{track}{suffix}" for track, suffix in product(TRACKS, (".tum", ".npz"))),
    ),
    "networks.json": (
        *("networks.csv", "ate_parameters.png", "distributions.png", "pde.png"),
        "trajectories.png",
    ),
    "groups.json": ("groups.csv", "recordings.csv", "groups.png"),
}
"""Files of a run, by one that only such a run writes: of every `run`, `compare` and `evaluate`; of
`run`; of a recording in `compare` and `evaluate`; of `evaluate --models`; of `evaluate --by`.

Those of `inspect` are not here: they describe the recording, and it writes all of them anew."""


def check_folder(folder: Path) -> None:
    """Check a folder for results before any work that could not be written; create nothing.

    Raises:
        InputError: the folder, or one above it, is a file or cannot be written to.
    """
    existing = next(part for part in (folder, *folder.parents) if part.exists())
    if not existing.is_dir():
        raise InputError(str(existing), "a file", "a folder, new or existing")
    if not os.access(existing, os.W_OK):
        raise InputError(str(existing), "no permission to write", "a folder that can be written")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents.

    Raises:
        InputError: the path is taken by something else, or permission is denied.
    """
    check_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            str(folder), error.strerror or "an error", "a folder that can be created"
        ) from error


def fresh_folder(folder: Path) -> None:
    """Create a folder, or remove the `RESULTS` of an earlier run from it; other files stay.

    Otherwise a report or another back end's track, left by that run, would pass for this one's.

    Raises:
        InputError: the folder cannot be created, or a file in it cannot be removed.
    """
    make_folder(folder)
    for mark, others in RESULTS.items():
        if (folder / mark).exists():
            for name in others:
                if name != mark:  # which goes last: a removal that fails can be repeated
                    _remove(folder / name)
            _remove(folder / mark)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or "an error"
        raise InputError(str(path), reason, "a file that can be replaced") from error
