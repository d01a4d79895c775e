"""Folders of results: created where missing, and never a mixture of two runs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from stario.fusion.evaluation.compare import TRACKS
from stario.sequences.drawing.figures import save_figure
from stario.sequences.errors import InputError
from stario.sequences.files import temporary_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Files = Mapping[str, Callable[[Path], object]]
"""Functions that write the files of a set of results, by their paths within its folder."""

_FIGURES = ("plan.png", "error.png", "innovations.png", "report.html")
_TRACKS = tuple(f"{track}{suffix}" for track, suffix in product(TRACKS, (".tum", ".npz")))

RESULTS = {
    "metrics.json": ("config.json", "run.json"),
    "health.json": (*_FIGURES, *_TRACKS[:4], "track.rrd", "track.geojson", "track.gpx"),
    "dead_reckoning.npz": (*_FIGURES, *_TRACKS, "truth.tum"),
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


def write_results(folder: Path, files: Files) -> list[Path]:
    """Write a set of results, which takes the place of an earlier one when it is whole.

    All are written into a temporary folder. At the end they move into `folder`, and the `RESULTS`
    of an earlier run that have no successor are removed, there and in the sub-folders that were
    written; other files stay. After an exception, or if the process ends, the earlier results are
    as they were. Of two runs the later one to end stays, whole.

    Raises:
        InputError: the folder cannot be created, or a file in it cannot be replaced.
    """
    check_folder(folder)
    make_folder(folder.parent)
    # Within a folder that exists: it may be a mount, to which no file of another one can move.
    place = folder / "results" if folder.is_dir() else folder
    with temporary_path(place, "a folder") as new:
        new.mkdir()
        for name, write in files.items():
            (new / name).parent.mkdir(exist_ok=True)
            write(new / name)
        folder.mkdir(exist_ok=True)
        with _locked(folder):
            for source in [new, *(path for path in new.iterdir() if path.is_dir())]:
                target = folder / source.relative_to(new)
                target.mkdir(exist_ok=True)
                written = [path for path in source.iterdir() if path.is_file()]
                stale = _results_in(target)
                for path in written:
                    path.replace(target / path.name)
                for path in stale:
                    if path.name not in {file.name for file in written}:
                        _remove(path)
        shutil.rmtree(new)
    return [folder / name for name in files]


def figure_files(figures: Mapping[str, Figure]) -> Files:
    """Return the files of figures by their names."""
    return {name: partial(save_figure, figure) for name, figure in figures.items()}


def _results_in(folder: Path) -> list[Path]:
    """Return the results of earlier runs in a folder, the files that mark them last."""
    marks = [mark for mark in RESULTS if (folder / mark).exists()]
    names = dict.fromkeys(name for mark in marks for name in RESULTS[mark] if name not in marks)
    return [folder / name for name in (*names, *marks) if (folder / name).exists()]


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Wait until no other process moves results into a folder; a lock ends with its process."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or "an error"
        raise InputError(str(path), reason, "a file that can be replaced") from error
