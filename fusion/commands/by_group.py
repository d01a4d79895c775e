"""`stario check fusion`, `fixes` and `gaps`: quality of tracks by group of recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stario.fusion.commands.common import exit_if_skipped, map_recordings, print_result
from stario.fusion.commands.options import (
    BackendOption,
    ByOption,
    EstimatorOptions,
    JsonOption,
    ReadingOptions,
    expand_option_groups,
)

if TYPE_CHECKING:
    from stario.fusion.backends import BackendName
    from stario.fusion.config import NavigatorConfig
    from stario.fusion.imu.stateful import Predictor
    from stario.sequences.sequence import ImuSequence

    Judge = Callable[[Predictor, ImuSequence, NavigatorConfig, str], Sequence[Any]]

RecordingsArgument = Annotated[
    list[Path],
    typer.Argument(metavar="PATH...", help="Recordings, folders, archives or list files."),
]


@expand_option_groups
def fusion(
    paths: RecordingsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    by: ByOption = "set",
    graph: Annotated[bool, typer.Option("--graph", help="Also run the graph (slower).")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compare the filter's error with the network's by group, with NIS and consistency of yaw."""
    from stario.fusion.evaluation.checks.fusion_gain import fusion_gain, fusion_gain_table

    backends: tuple[BackendName, ...] = ("ekf", "graph") if graph else ("ekf",)
    _judge_each(
        "check fusion",
        (reading, paths, estimating, by, as_json),
        lambda model, recording, config, group: [
            fusion_gain(model, recording, config, group, backends)
        ],
        fusion_gain_table,
    )


@expand_option_groups
def fixes(
    paths: RecordingsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    every: Annotated[float, typer.Option(min=0.1, help="Interval between fixes in s.")] = 5.0,
    sigma: Annotated[float, typer.Option(min=0.001, help="Fix sigma per axis \\[m].")] = 0.3,
    backend: BackendOption = "ekf",
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Supply periodic true positions; check that position and yaw errors match their sigmas."""
    from stario.fusion.evaluation.checks.with_fixes import fixes_table, track_with_fixes

    _judge_each(
        "check fixes",
        (reading, paths, estimating, by, as_json),
        lambda model, recording, config, group: [
            track_with_fixes(model, recording, config, group, every, sigma, backend=backend)  # type: ignore[arg-type]
        ],
        fixes_table,
    )


@expand_option_groups
def gaps(
    paths: RecordingsArgument,
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Remove 0.1 s at one of six instants or 5 % of the samples; report how far the end moves."""
    from stario.fusion.evaluation.checks.sample_loss import end_shift_table, end_shifts

    _judge_each(
        "check gaps", (reading, paths, estimating, by, as_json), end_shifts, end_shift_table
    )


def _judge_each(
    title: str,
    options: tuple[ReadingOptions, Sequence[Path], EstimatorOptions, str, bool],
    judge: Judge,
    table: Callable[[Sequence[Any]], str],
) -> None:
    """Evaluate each recording, print a table or JSON, and exit with 1 if any was skipped."""
    from stario.fusion.evaluation.judging.judge import check_by, labels

    reading, paths, estimating, by, as_json = options
    grouping = check_by(by)
    model, settings = estimating.network(), estimating.settings()

    def judged(path: Path, sequence: ImuSequence) -> Sequence[Any]:
        return judge(model, sequence, settings, labels(path, sequence.attributes)[grouping])

    results, skipped = map_recordings(title, reading, paths, judged)
    found = [result for group in results for result in group]
    if as_json or found:
        print_result(as_json, [asdict(result) for result in found], table(found) if found else "")
    exit_if_skipped(skipped)
