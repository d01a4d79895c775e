"""`stario run`, `inspect` and `live`: tracks of recordings, what they are like, live tracks."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError
from stario.sequences.lazy import optional_package

if TYPE_CHECKING:
    from stario.fusion.evaluation.compare import Comparison
    from stario.sequences.sequence import ImuSequence


@options.expanded
def run(
    paths: options.Paths,
    reading: options.Reading,
    estimating: options.Estimator,
    placing: options.Place,
    fixes: options.Fixes = None,
    out: options.RunOut = None,
    filtered: bool = options.flag(
        False, "--filtered", help="Also write the filter's track, as a stream gives it."
    ),
    report: options.Report = False,
    tiles: options.Tiles = "",
    view: bool = options.flag(
        False, "--view", help="Open the rerun 3-D viewer; its file is kept in --out."
    ),
    as_json: options.Json = False,
    explained: options.Explain = False,
) -> None:
    """Fuse each recording into a smooth track with attitude, velocity, biases and covariance."""
    from stario.fusion.evaluation.compare import measured
    from stario.fusion.evaluation.results import write_run
    from stario.fusion.evaluation.text import track_figures
    from stario.fusion.navigator import Navigator
    from stario.fusion.values.fix_file import check_within, read_fixes

    also = common.further_files(report, tiles, view)
    network = estimating.network()
    navigator = Navigator(network, placing.settings(estimating.settings()))
    given = [] if fixes is None else read_fixes(fixes)
    if explained:
        common.explain(as_json)
    origin = common.origin_of(paths, reading, estimating, network, fixes)
    train = common.training_command(paths, reading, estimating.model)

    def fuse(sequence: ImuSequence, folder: Path) -> tuple[dict[str, object], str]:
        """Write one recording's track; return its record and a summary."""
        check_within(given, sequence)
        with common.progress_bar(f"run {sequence.name}") as progress:
            track = navigator.run(sequence, progress, given)
        tracks = {"track": track}
        if filtered and track.filtered is not None:
            tracks["filtered"] = track.filtered
        found = replace(measured(sequence, tracks, navigator.config.place), train=train)
        written = write_run(folder, found, navigator.config, origin, also)
        if view:
            from stario.fusion.report.view import open_view

            open_view(folder / "track.rrd")
        sigma = track.health.final_sigma if track.health else {}
        summary = {**track_figures(track), "final_sigma": sigma}
        record: dict[str, object] = {"recording": sequence.name, "summary": summary}
        record |= found.metrics
        record |= {"verdict": [asdict(f) for f in found.verdict], "folder": str(folder)}
        lines = [*_lines(found), f"{folder}: {', '.join(path.name for path in written)}"]
        return record, "\n".join(lines)

    common.process_each(reading, paths, out, fuse, as_json, "--fixes" if fixes else "")


def _lines(found: Comparison) -> list[str]:
    """Return what was recorded, the track, its errors and the verdict, a fact per line."""
    from stario.fusion.evaluation.text import error_words, place_words, track_words

    lines = [found.sequence.summary(), f"track: {track_words(found)}"]
    lines += [f"place: {words}"] if (words := place_words(found)) else []
    for name in found.tracks:
        if words := error_words(found, name):
            lines.append(f"{'error' if name == 'track' else f'{name}, error'}: {words}")
    return [*lines, *(finding.line() for finding in found.verdict)]


@options.expanded
def inspect(
    paths: options.Paths,
    reading: options.Reading,
    model: str = typer.Option("default", help="Weights that the recording is tried with."),
    out: Path | None = typer.Option(
        None, help="Folder for figure and findings. Default: runs/NAME."
    ),
    as_json: options.Json = False,
) -> None:
    """Inspect recordings: timing, noise, units, signs, magnetometer, truth, track."""
    from stario.fusion.evaluation.known_positions import recording_verdict
    from stario.fusion.navigator import Navigator
    from stario.network.model import load_model
    from stario.sequences.drawing.figures import save_figure
    from stario.sequences.drawing.plots import imu_overview
    from stario.sequences.files import make_folder, write_json
    from stario.sequences.inspection.report import inspect_recording
    from stario.sequences.inspection.samples import without_times_ahead

    train = common.training_command(paths, reading, model)
    navigator = Navigator(load_model(model))

    def inspected(given: ImuSequence, folder: Path) -> tuple[dict[str, object], str]:
        """Write one recording's figure and findings; return its record and the findings."""
        found, sequence = inspect_recording(given), without_times_ahead(given)
        make_folder(folder)
        fit, rest = found.fit, found.rest
        figure = imu_overview(
            sequence,
            rotation=None if fit is None else (fit.times, fit.speed),
            rest=rest.stretches if rest else (),
            gaps=[
                (gap["start_s"], gap["start_s"] + gap["length_s"]) for gap in found.figures["gaps"]
            ],
        )
        save_figure(figure, folder / "inspection.png")
        track = None
        with suppress(InputError):  # refused: the inspection gives the reason
            track = navigator.run(given)
        verdict = recording_verdict(given, track, found, train)
        record = found.as_dict() | {"verdict": [asdict(finding) for finding in verdict]}
        write_json(folder / "inspection.json", record)
        lines = [sequence.summary(), *found.lines(), *(finding.line() for finding in verdict)]
        return record, "\n".join([*lines, f"figure: {folder / 'inspection.png'}"])

    common.process_each(reading, paths, out, inspected, as_json)


@options.expanded
def live(
    estimating: options.Estimator,
    placing: options.Map,
    port: int = typer.Option(8000, min=0, max=65535, help="Port of page and pushes."),
    host: str = typer.Option(
        "127.0.0.1", help="Address to listen on; 0.0.0.0 admits phones, with a token."
    ),
    phyphox: list[str] | None = typer.Option(
        None, help="Address of a phone running phyphox; repeatable."
    ),
    tiles: options.Tiles = "",
    demo: bool = options.flag(False, "--demo", help="Let a simulated phone walk."),
    out: Path = typer.Option(Path("runs/live"), help="Folder for the recordings."),
) -> None:
    """Show live tracks on a web page, from Sensor Logger, phyphox or any device that posts JSON."""
    for package in ("starlette", "uvicorn", "jinja2", "plotly", "segno"):
        optional_package(package, "live")
    from stario.fusion.live.run import LiveServer
    from stario.fusion.navigator import Navigator
    from stario.sequences.files import check_folder

    model, settings = estimating.network(), placing.settings(estimating.settings())
    if settings.place.origin is not None and len(settings.place.origin) > 2:
        fix = "leave it out: satellites, or two places given on the page, turn the track"
        raise InputError("--origin", "a yaw", "LAT,LON: the page has x east", fix)
    if tiles:
        from stario.fusion.report.background import check_tiles

        check_tiles(tiles)
    check_folder(out)
    simulated = None
    if demo:
        from stario.fusion import demonstration

        simulated = demonstration()
    server = LiveServer(
        lambda: Navigator(model, settings), out, host, port, phyphox or [], simulated, tiles
    )
    server.run(started=lambda: typer.echo("\n".join(server.addresses()), err=True))
