"""Output folders: tracks, metrics, configuration, health, figures; never a mixture of two runs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import pandas as pd

from stario.fusion.evaluation.compare import (
    METRIC_WORDS,
    METRICS,
    RECORDING_WORDS,
    TRACKS,
    Comparison,
)
from stario.fusion.evaluation.known_positions import shown_positions
from stario.fusion.evaluation.map_files import on_map, write_geojson, write_gpx
from stario.fusion.evaluation.scores import joined
from stario.fusion.values.config import NavigatorConfig
from stario.sequences.drawing.figures import save_figure
from stario.sequences.drawing.plan import plan_view
from stario.sequences.drawing.plots import error_over_time, innovations
from stario.sequences.errors import InputError
from stario.sequences.files import check_folder, make_folder, temporary_path, write_json, write_npz
from stario.sequences.readers.tum import write_tum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Files = Mapping[str, Callable[[Path], object]]
"""Functions that write the files of a set of results, by their paths within its folder."""

Writers = Mapping[str, Callable[..., object]]
"""Functions of a path and a comparison, `found`, that write further files, by their names."""

_FIGURES = ("plan.png", "error.png", "innovations.png", "report.html")
_TRACKS = tuple(f"{track}{suffix}" for track, suffix in product(TRACKS, (".tum", ".npz")))

RESULTS = {
    "metrics.json": ("config.json", "run.json"),
    "health.json": (*_FIGURES, *_TRACKS[:4], "track.rrd", "track.geojson", "track.gpx"),
    "dead_reckoning.npz": (*_FIGURES, *_TRACKS, "truth.tum"),
    "groups.json": ("groups.csv", "recordings.csv", "groups.png"),
}
"""Files of a run, by one that only such a run writes: of every `run`, `compare` and `evaluate`; of
`run`; of a recording in `compare` and `evaluate`; of `evaluate --by`.

Those of `inspect` are not here: they describe the recording, and it writes all of them anew."""


def write_run(
    folder: Path,
    run: Comparison,
    config: NavigatorConfig,
    origin: Mapping[str, object],
    also: Writers = MappingProxyType({}),
) -> list[Path]:
    """Write the tracks of a run, and return the files written.

    These are `track.tum` (9 decimals), `track.npz` (velocity, biases, covariance), `metrics.json`,
    `config.json`, `run.json` (`origin`: what produced them), `health.json` and the figures; with
    the filter's track also `filtered.tum` and `filtered.npz`; where it is known where on the earth
    the track lies, also `track.geojson` and `track.gpx` (`map_files`). Without truth, known
    positions in the track's frame (`known_positions.placed`) are drawn. Raises what `write_results`
    does.
    """
    metrics = {"recording": run.sequence.name, **run.metrics, "conventions": run.words}
    health = run.track.health
    files: Files = {
        **_tracks(run),
        **_settings(metrics, config, origin),
        "health.json": partial(write_json, obj=asdict(health) if health else None),
        **_figures(run),
        **_on_map(run),
        **{name: partial(write, found=run) for name, write in also.items()},
    }
    return write_results(folder, files)


def write_comparison(
    folder: Path,
    comparisons: Sequence[Comparison],
    config: NavigatorConfig,
    origin: Mapping[str, object],
    also: Writers = MappingProxyType({}),
) -> list[Path]:
    """Write what `write_summary` does, and a sub-folder of tracks and figures per recording.

    Other recordings' folders stay. Raises what `write_results` does.
    """
    metrics = metrics_dict(joined(found.scores for found in comparisons), comparisons[0].words)
    files = dict(_settings(metrics, config, origin))
    for found in comparisons:
        inner = _recording(found, also)
        files |= {f"{found.sequence.name}/{name}": write for name, write in inner.items()}
    return write_results(folder, files)


def write_summary(
    folder: Path, scores: pd.DataFrame, config: NavigatorConfig, origin: Mapping[str, object]
) -> None:
    """Write `metrics.json`, `config.json` and `run.json` of recordings; raises as `write_run`."""
    write_results(folder, _settings(metrics_dict(scores), config, origin))


def write_recording(folder: Path, found: Comparison) -> None:
    """Write tracks and figures of a recording into a sub-folder named after it, as `write_run`."""
    write_results(folder / found.sequence.name, _recording(found))


def metrics_dict(
    scores: pd.DataFrame, words: Mapping[str, str] = METRIC_WORDS
) -> dict[str, object]:
    """Return the content of `metrics.json` from the `scores` of comparisons."""
    recordings = {}
    for name, found in scores.groupby("recording", sort=False):
        about, tracks = found.iloc[0][[*RECORDING_WORDS]], found.set_index("track")[[*METRICS]]
        recordings[name] = {**about, "tracks": tracks.to_dict("index")}
    return {"recordings": recordings, "conventions": {**RECORDING_WORDS, **words}}


def figure_files(figures: Mapping[str, Figure]) -> Files:
    """Return the files of figures by their names."""
    return {name: partial(save_figure, figure) for name, figure in figures.items()}


def _settings(metrics: object, config: NavigatorConfig, origin: Mapping[str, object]) -> Files:
    contents = {"metrics.json": metrics, "config.json": asdict(config), "run.json": origin}
    return {name: partial(write_json, obj=content) for name, content in contents.items()}


def _recording(found: Comparison, also: Writers = MappingProxyType({})) -> Files:
    truth = found.sequence.truth
    known = {} if truth is None else {"truth.tum": partial(write_tum, trajectory=truth)}
    further = {name: partial(write, found=found) for name, write in also.items()}
    return {**_tracks(found), **known, **_figures(found), **further}


def _tracks(found: Comparison) -> Files:
    files: dict[str, Callable[[Path], object]] = {}
    for name, track in found.tracks.items():
        files[f"{name}.tum"] = partial(write_tum, trajectory=track.trajectory)
        files[f"{name}.npz"] = partial(write_npz, **track.arrays())
    return files


def _on_map(run: Comparison) -> Files:
    """Return the main track's files for maps, if it is known where on the earth it lies."""
    if run.georeference is None:
        return {}
    parts, name = on_map(run.track, run.georeference), run.sequence.name
    return {
        "track.geojson": partial(write_geojson, name=name, parts=parts),
        "track.gpx": partial(write_gpx, name=name, parts=parts),
    }


def _figures(found: Comparison) -> Files:
    """Return plan and errors of all tracks, and the filter's innovations."""
    name, truth, tracks = found.sequence.name, found.sequence.truth, found.aligned()
    track = found.track
    figures = {"plan.png": plan_view(tracks, truth, name, shown_positions(found.sequence, track))}
    if truth is not None:
        shown = {k: v for k, v in tracks.items() if k != "dead_reckoning"}
        figures["error.png"] = error_over_time(shown, truth, f"{name}: position error")
    drawn = track.innovations
    if drawn is not None and len(drawn.time):
        values = drawn.time, drawn.residual_W, drawn.sigma, drawn.nis, drawn.gated
        figures["innovations.png"] = innovations(*values, f"{name}: innovations")
    return figure_files(figures)


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
    # Within a folder that exists: it may be a mount, to which no file of another one can move.
    existing = next(part for part in (folder, *folder.parents) if part.is_dir())
    with temporary_path(existing / "results", "a folder") as new:
        new.mkdir()
        for name, write in files.items():
            (new / name).parent.mkdir(exist_ok=True)
            write(new / name)
        make_folder(folder)
        with _locked(folder):
            for source in [new, *(path for path in new.iterdir() if path.is_dir())]:
                _move_results(source, folder / source.relative_to(new))
        shutil.rmtree(new)
    return [folder / name for name in files]


def _move_results(source: Path, target: Path) -> None:
    """Move files into a folder, and remove results of earlier runs, files that mark these last."""
    target.mkdir(exist_ok=True)
    marks = [mark for mark in RESULTS if (target / mark).exists()]
    stale = dict.fromkeys([*(name for mark in marks for name in RESULTS[mark]), *marks])
    for path in [path for path in source.iterdir() if path.is_file()]:
        path.replace(target / path.name)
        stale.pop(path.name, None)
    try:
        for name in sorted(stale, key=marks.__contains__):
            (target / name).unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or "an error"
        raise InputError(str(target / name), reason, "a file that can be replaced") from error


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
