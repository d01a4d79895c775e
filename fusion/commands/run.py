"""`stario run`: fuse recordings into tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from stario.fusion.commands.common import origin_of, process_each, progress_bar
from stario.fusion.commands.options import (
    BackendOption,
    EstimatorOptions,
    FixesOption,
    JsonOption,
    PathsArgument,
    ReadingOptions,
    ReportOption,
    RunOutOption,
    expand_option_groups,
    flag,
)

if TYPE_CHECKING:
    from stario.fusion.evaluation.compare import Comparison
    from stario.fusion.fixes import Fix
    from stario.fusion.navigator import Navigator
    from stario.fusion.state import Track
    from stario.sequences.sequence import ImuSequence


@expand_option_groups
def run(
    paths: PathsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    fixes: FixesOption = None,
    backend: BackendOption = "ekf",
    out: RunOutOption = None,
    report: ReportOption = False,
    view: Annotated[
        bool, flag("--view", help="Open the rerun 3-D viewer; its file is kept in --out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fuse each recording into a track with attitude, velocity, biases and covariance."""
    from stario.fusion.backends import BackendName
    from stario.fusion.fix_file import read_fixes
    from stario.fusion.navigator import Navigator
    from stario.sequences.arrays import check_choice
    from stario.sequences.lazy import optional_package

    if report:
        optional_package("plotly", "report")
    if view:
        optional_package("rerun", "view")
    chosen: BackendName = check_choice("--backend", backend, get_args(BackendName))
    network = estimating.network()
    navigator = Navigator(network, estimating.settings(), backend=chosen)
    absolute_fixes = [] if fixes is None else read_fixes(fixes)
    words: dict[str, str] = {}
    work = partial(
        _run,
        navigator=navigator,
        fixes=absolute_fixes,
        origin=origin_of([chosen], paths, reading, estimating, network, fixes),
        report=report,
        view=view,
        words=words,
    )
    process_each(reading, paths, out, work, as_json, "--fixes" if fixes else "", words)


def _run(
    sequence: ImuSequence,
    folder: Path,
    navigator: Navigator,
    fixes: Sequence[Fix],
    origin: dict[str, object],
    report: bool,
    view: bool,
    words: dict[str, str],
) -> tuple[dict[str, object], str]:
    """Write one recording's track; return its record and a summary; `words` explain its columns."""
    from stario.fusion.evaluation.compare import measured
    from stario.fusion.evaluation.results import write_run
    from stario.fusion.evaluation.text import column_words
    from stario.fusion.fix_file import check_within
    from stario.sequences.inspection.gyro_axes import compare_gyro_axes
    from stario.sequences.truth.problems import warn_of_truth

    check_within(fixes, sequence)
    with progress_bar(f"run {sequence.name}") as progress:
        track = navigator.run(sequence, progress, fixes)
    for line in compare_gyro_axes(sequence).problems(sequence.name):
        typer.echo(f"stario: {line}", err=True)
    warn_of_truth(sequence)
    found = measured(sequence, {navigator.backend: track}, fixes)
    also: dict[str, Callable[[Path, Comparison], object]] = {}
    if report:
        from stario.fusion.report.page import write_report

        also["report.html"] = write_report
    if view:
        from stario.fusion.report.view import open_view, write_view

        also["track.rrd"] = write_view
    written = write_run(folder, found, navigator.config, origin, also)
    if view:
        open_view(folder / "track.rrd")
    if sequence.truth is not None:
        words |= column_words(found)
    lines = [*_lines(found, track), f"{len(written)} files in {folder}"]
    record: dict[str, object] = {"recording": sequence.name, **found.metrics}
    return record | {"folder": str(folder)}, "\n".join(lines)


def _lines(found: Comparison, track: Track) -> list[str]:
    """Return what was recorded, the track, its errors and its health as lines of text."""
    import numpy as np

    from stario.fusion.evaluation.known_positions import position_error_words
    from stario.fusion.evaluation.text import track_table, tracked_words
    from stario.fusion.report.health import health_lines

    sequence = found.sequence
    length = track.trajectory.path_length()
    ends = np.linalg.norm(np.diff(track.trajectory.position_W[[0, -1], :2], axis=0))
    lines = [
        sequence.summary(),
        f"{sequence.name}: {tracked_words(found)}, {length:.1f} m travelled (estimated), "
        f"ending {ends:.1f} m from the start",
    ]
    if sequence.truth is not None:
        lines.append(track_table(found))
    elif sequence.positions is not None:
        lines.append(position_error_words(track, sequence.positions))
    if track.health is not None:
        lines += [*track.health.lines(), *health_lines(track.health)]
    return lines
