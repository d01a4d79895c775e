"""Output folder of a run: tracks, arrays, metrics, configuration, health and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import MappingProxyType

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.compare import METRIC_WORDS, RECORDING_WORDS, Comparison
from stario.fusion.evaluation.folders import Files, figure_files, write_results
from stario.fusion.evaluation.known_positions import shown_positions
from stario.fusion.evaluation.map_files import on_map, write_geojson, write_gpx
from stario.sequences.drawing.plan import plan_view
from stario.sequences.drawing.plots import error_over_time, innovations
from stario.sequences.files import write_json, write_npz
from stario.sequences.readers.tum import write_tum

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
        **_further(run, also),
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
    records = {found.sequence.name: found.as_dict() for found in comparisons}
    files = dict(_settings(metrics_dict(records, comparisons[0].words), config, origin))
    for found in comparisons:
        inner = _recording(found, also)
        files |= {f"{found.sequence.name}/{name}": write for name, write in inner.items()}
    return write_results(folder, files)


def write_summary(
    folder: Path,
    records: Mapping[str, object],
    config: NavigatorConfig,
    origin: Mapping[str, object],
) -> None:
    """Write `metrics.json`, `config.json` and `run.json` of recordings; raises as `write_run`."""
    write_results(folder, _settings(metrics_dict(records), config, origin))


def write_recording(folder: Path, found: Comparison) -> None:
    """Write tracks and figures of a recording into a sub-folder named after it, as `write_run`."""
    write_results(folder / found.sequence.name, _recording(found))


def metrics_dict(
    records: Mapping[str, object], words: Mapping[str, str] = METRIC_WORDS
) -> dict[str, object]:
    """Return the content of `metrics.json` from the entries of recordings (`as_dict`), by name."""
    return {"recordings": records, "conventions": {**RECORDING_WORDS, **words}}


def _settings(metrics: object, config: NavigatorConfig, origin: Mapping[str, object]) -> Files:
    contents = {"metrics.json": metrics, "config.json": asdict(config), "run.json": origin}
    return {name: partial(write_json, obj=content) for name, content in contents.items()}


def _recording(found: Comparison, also: Writers = MappingProxyType({})) -> Files:
    truth = found.sequence.truth
    known = {} if truth is None else {"truth.tum": partial(write_tum, trajectory=truth)}
    return {**_tracks(found), **known, **_figures(found), **_further(found, also)}


def _further(found: Comparison, also: Writers) -> Files:
    def bound(write: Callable[[Path, Comparison], object]) -> Callable[[Path], object]:
        return lambda path: write(path, found)

    return {name: bound(write) for name, write in also.items()}


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
    found, name = on_map(run.track, run.georeference), run.sequence.name
    return {
        "track.geojson": partial(write_geojson, name=name, found=found),
        "track.gpx": partial(write_gpx, name=name, found=found),
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
