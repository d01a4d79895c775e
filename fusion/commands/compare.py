"""`stario compare`: all tracks of each recording side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands.common import (
    exit_if_skipped,
    explanations,
    origin_of,
    print_result,
    progress_bar,
)
from stario.fusion.commands.options import (
    CompareOutOption,
    EstimatorOptions,
    FixesOption,
    JobsOption,
    JsonOption,
    OptionalPathsArgument,
    ReadingOptions,
    ReportOption,
    changed,
    expand_option_groups,
    refuse_unused,
)
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.evaluation.compare import Comparison
    from stario.sequences.sequence import ImuSequence


@expand_option_groups
def compare(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    paths: OptionalPathsArgument = None,
    fixes: FixesOption = None,
    jobs: JobsOption = 1,
    out: CompareOutOption = None,
    report: ReportOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare tracks: inertial, pdr (from steps), network, EKF and graph.

    Without PATH, those of a simulated walk.
    """
    from stario.fusion.backends import BACKENDS
    from stario.fusion.evaluation.compare import compare_recordings, demonstration
    from stario.fusion.evaluation.folders import check_folder
    from stario.fusion.evaluation.results import scores_dict, write_comparison
    from stario.fusion.evaluation.summary import scores_of
    from stario.fusion.evaluation.text import column_words
    from stario.fusion.fix_file import read_fixes
    from stario.sequences.datasets.batch import without_skipped
    from stario.sequences.lazy import optional_package

    if not paths:
        refuse_unused(changed(reading), "without PATH", "use with a recording to read")
    if report:
        optional_package("plotly", "report")
    settings, network = estimating.settings(), estimating.network()
    model = estimating.for_processes(network, jobs)
    absolute_fixes = [] if fixes is None else read_fixes(fixes)
    files, skipped = reading.recordings(paths or [])
    origin = origin_of(BACKENDS, files, reading, estimating, network, fixes)
    read: Callable[[Path], ImuSequence] = reading.read
    if not paths:
        typer.echo("demonstration: a simulated walk not used in training", err=True)
        files, read = [Path("demonstration")], lambda path: demonstration()
    if fixes is not None and len(files) > 1:
        raise InputError("--fixes", f"{len(files)} recordings", "one recording")
    folder = out or Path("runs") / "compare"
    check_folder(folder)
    with progress_bar("compare", 100 * len(files)) as progress:
        outcomes = compare_recordings(
            files, model, settings, read, jobs, absolute_fixes, progress=progress
        )
        comparisons = list(without_skipped(outcomes, skipped))
    also = {}
    if report:
        from stario.fusion.report.page import write_report

        also["report.html"] = write_report
    if comparisons:
        written = write_comparison(folder, comparisons, settings, origin, also)
        lines = [line for comparison in comparisons for line in _lines(comparison)]
        words = {k: v for comparison in comparisons for k, v in column_words(comparison).items()}
        lines += explanations(words)
        lines.append(f"{len(written)} files in {folder}")
        scores = [scores_of(comparison) for comparison in comparisons]
        print_result(as_json, scores_dict(scores), "\n".join(lines))
    exit_if_skipped(skipped)


def _lines(comparison: Comparison) -> list[str]:
    from stario.fusion.evaluation.text import track_table, tracked_words

    sequence, path = comparison.sequence, comparison.path_m
    length = f"truth: {sequence.truth_summary()}" if path is None else f"{path:.1f} m"
    lines = [
        f"{sequence.name}: {tracked_words(comparison)}, {length}",
        track_table(comparison),
    ]
    if sequence.truth is None and sequence.positions is not None:
        from stario.fusion.evaluation.known_positions import position_error_words

        for name, track in comparison.tracks.items():
            lines.append(f"{name}: {position_error_words(track, sequence.positions)}")
    return lines
