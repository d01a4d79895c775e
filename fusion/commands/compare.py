"""`stario compare`: tracks of each recording side by side."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.evaluation.compare import Comparison
    from stario.sequences.sequence import ImuSequence

_SHOWN = ("track", "dead_reckoning")
"""Tracks without `--tracks`: what StarIO gives, and what one would have without it."""


@options.expanded
def compare(
    context: typer.Context,
    reading: options.Reading,
    estimating: options.Estimator,
    placing: options.Place,
    paths: options.OptionalPaths = None,
    fixes: options.Fixes = None,
    jobs: options.Jobs = 1,
    out: options.CompareOut = None,
    tracks: str = typer.Option(
        "",
        help="Further tracks, also as a table: filtered, network, network_true_attitude, pdr "
        "(from steps), separated by commas, or all.",
    ),
    report: options.Report = False,
    as_json: options.Json = False,
    explained: options.Explain = False,
) -> None:
    """Compare each recording's track with its truth and with dead reckoning by the IMU alone.

    Without PATH, that of a simulated walk.
    """
    from stario.fusion.evaluation.compare import TRACKS, compare_recordings, demonstration
    from stario.fusion.evaluation.results import check_folder, metrics_dict, write_comparison
    from stario.fusion.evaluation.scores import joined
    from stario.fusion.values.fix_file import read_fixes
    from stario.sequences.arrays import check_choice
    from stario.sequences.datasets.batch import without_skipped

    if not paths:
        options.refuse(context, "without PATH", "use with a recording to read", *options.READING)
    also = common.further_files(report)
    chosen = TRACKS if tracks == "all" else [*_SHOWN, *(common.names_in(tracks) if tracks else [])]
    for name in chosen:
        check_choice("--tracks", name, TRACKS)
    settings, network = placing.settings(estimating.settings()), estimating.network()
    model = estimating.for_processes(network, jobs)
    absolute_fixes = [] if fixes is None else read_fixes(fixes)
    files, skipped = reading.recordings(paths or [])
    origin = common.origin_of(files, reading, estimating, network, fixes)
    read: Callable[[Path], ImuSequence] = reading.read
    if not paths:
        files, read = [Path("demonstration")], lambda path: demonstration()
    if fixes is not None and len(files) > 1:
        raise InputError("--fixes", f"{len(files)} recordings", "one recording")
    folder = out or Path("runs") / "compare"
    check_folder(folder)
    with common.progress_bar("compare", 100 * len(files)) as progress:
        outcomes = compare_recordings(
            files, model, settings, read, jobs, absolute_fixes, progress=progress, names=chosen
        )
        train = common.training_command(paths, reading) if paths else ""
        comparisons = [replace(c, train=train) for c in without_skipped(outcomes, skipped)]
    if explained:
        common.explain()
    if comparisons:
        written = write_comparison(folder, comparisons, settings, origin, also)
        lines = [line for found in comparisons for line in _lines(found, bool(tracks))]
        first = folder / comparisons[0].sequence.name / "plan.png"
        lines.append(f"figures and tracks: {first} and {len(written) - 1} other files")
        if not paths:
            command = "stario" if shutil.which("stario") else sys.argv[0]  # in no PATH: its own
            lines.append(f"next: {command} run FILE --report, with a phone's recording")
        scores = joined(found.scores for found in comparisons)
        common.print_result(as_json, metrics_dict(scores, comparisons[0].words), "\n".join(lines))
    common.exit_if_skipped(skipped)


def _lines(found: Comparison, as_table: bool) -> list[str]:
    """Return how good the track is beside dead reckoning, and perhaps a table of all tracks."""
    from stario.fusion.evaluation.text import error_words, place_words, track_table, track_words
    from stario.sequences.drawing.figures import distance

    alone = found.metrics["dead_reckoning"]
    far = alone["ate_m"] or alone["known_positions_m"]
    far = far or found.tracks["dead_reckoning"].trajectory.path_length()
    words = error_words(found) or place_words(found) or track_words(found)
    line = f"{found.sequence.name}: StarIO's track: {words}; dead reckoning: {distance(far)}"
    table = [track_table(found)] if as_table else []
    return [line, *table, *(finding.line() for finding in found.verdict)]
