"""Output folder of a run: tracks, arrays, metrics, configuration, health and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.compare import METRIC_WORDS, RECORDING_WORDS, Comparison
from stario.fusion.evaluation.folders import results_folder
from stario.fusion.evaluation.known_positions import shown_positions
from stario.fusion.evaluation.map_files import on_map, write_geojson, write_gpx
from stario.sequences.drawing.figures import save_figure
from stario.sequences.drawing.plan import plan_view
from stario.sequences.drawing.plots import error_over_time, innovations
from stario.sequences.files import write_json, write_npz
from stario.sequences.readers.tum import write_tum

if TYPE_CHECKING:
    from stario.fusion.evaluation.summary import Scores


Writers = Mapping[str, Callable[[Path, Comparison], object]]
"""Functions that write a recording's further files, by the files' names."""


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
    positions in the track's frame (`known_positions.placed`) are drawn. Results of an earlier run
    into this folder are removed.

    Raises:
        InputError: the folder cannot be created.
    """
    health = run.track.health
    contents = {
        "metrics.json": {"recording": run.sequence.name, **run.metrics, "conventions": run.words},
        "config.json": asdict(config),
        "run.json": origin,
        "health.json": asdict(health) if health else None,
    }
    with results_folder(folder) as new:
        written = _track_files(new, run)
        written += [*_json_files(new, contents), *_figures(new, run), *_further(new, run, also)]
        written += _map_files(new, run)
    return [folder / path.relative_to(new) for path in written]


def write_comparison(
    folder: Path,
    comparisons: Sequence[Comparison],
    config: NavigatorConfig,
    origin: Mapping[str, object],
    also: Writers = MappingProxyType({}),
) -> list[Path]:
    """Write what `write_summary` does, and a sub-folder of tracks and figures per recording.

    Results of an earlier run into these folders are removed; other recordings' folders stay.

    Raises:
        InputError: a folder cannot be created.
    """
    from stario.fusion.evaluation.summary import scores_of  # pandas, which a run does not need

    with results_folder(folder) as new:
        written = write_summary(new, [scores_of(c) for c in comparisons], config, origin)
        for comparison in comparisons:
            written += write_recording(new, comparison, also)
    return [folder / path.relative_to(new) for path in written]


def write_summary(
    folder: Path,
    recordings: Sequence[Scores],
    config: NavigatorConfig,
    origin: Mapping[str, object],
) -> list[Path]:
    """Write `metrics.json`, `config.json` and `run.json` of recordings, in place of earlier ones.

    Raises:
        InputError: the folder cannot be created.
    """
    contents = {
        "metrics.json": scores_dict(recordings),
        "config.json": asdict(config),
        "run.json": origin,
    }
    with results_folder(folder) as new:
        _json_files(new, contents)
    return [folder / file for file in contents]


def _json_files(folder: Path, contents: Mapping[str, object]) -> list[Path]:
    for file, content in contents.items():
        write_json(folder / file, content)
    return [folder / file for file in contents]


def _further(folder: Path, run: Comparison, also: Writers) -> list[Path]:
    for name, write in also.items():
        write(folder / name, run)
    return [folder / name for name in also]


def write_recording(
    folder: Path, comparison: Comparison, also: Writers = MappingProxyType({})
) -> list[Path]:
    """Write tracks and figures of one recording into a sub-folder named after it.

    Raises:
        InputError: a folder cannot be created.
    """
    inner = folder / comparison.sequence.name
    truth = comparison.sequence.truth
    with results_folder(inner) as new:
        written = _track_files(new, comparison)
        if truth is not None:
            write_tum(new / "truth.tum", truth)
            written.append(new / "truth.tum")
        written += [*_figures(new, comparison), *_further(new, comparison, also)]
    return [inner / path.relative_to(new) for path in written]


def scores_dict(recordings: Sequence[Scores]) -> dict[str, object]:
    """Return the content of `metrics.json`."""
    records = {scores.name: scores.record for scores in recordings}
    # Fixes change how tracks are aligned; they are given for a single recording only.
    words = next((scores.words for scores in recordings), METRIC_WORDS)
    return {"recordings": records, "conventions": RECORDING_WORDS | words}


def _track_files(folder: Path, found: Comparison) -> list[Path]:
    written = []
    for name, track in found.tracks.items():
        written += [folder / f"{name}.tum", folder / f"{name}.npz"]
        write_tum(written[-2], track.trajectory)
        write_npz(written[-1], **track.arrays())
    return written


def _map_files(folder: Path, run: Comparison) -> list[Path]:
    """Write the main track for maps, if it is known where on the earth it lies."""
    if run.georeference is None:
        return []
    found, name = on_map(run.track, run.georeference), run.sequence.name
    return [
        write_geojson(folder / "track.geojson", name, found),
        write_gpx(folder / "track.gpx", name, found),
    ]


def _figures(folder: Path, found: Comparison) -> list[Path]:
    """Write plan and errors of all tracks, and the filter's innovations."""
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
    for file, figure in figures.items():
        save_figure(figure, folder / file)
    return [folder / file for file in figures]
