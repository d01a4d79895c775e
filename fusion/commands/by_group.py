"""`stario check fusion`, `fixes` and `gaps`: what tracks are worth, by groups of recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stario.fusion.commands.common import leave_with_skipped, print_json, result_of_each
from stario.fusion.commands.options import (
    BackendOption,
    ByOption,
    Estimating,
    JsonOption,
    Reading,
    grouped,
)

if TYPE_CHECKING:
    from stario.fusion.backends import BackendName
    from stario.fusion.config import NavigatorConfig
    from stario.fusion.imu.stateful import Predictor
    from stario.sequences.sequence import ImuSequence

    Judge = Callable[[Predictor, ImuSequence, NavigatorConfig, str], Sequence[Any]]

RecordingsArgument = Annotated[
    list[Path], typer.Argument(help="Recordings, folders, archives or lists.")
]


@grouped
def fusion(
    paths: RecordingsArgument,
    reading: Reading,
    estimating: Estimating,
    by: ByOption = "set",
    graph: Annotated[bool, typer.Option("--graph", help="The graph as well; slower.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Hold the filter's error against its network's, with NIS and honesty of the yaw, by group."""
    from stario.fusion.evaluation.checks.worth import worth_of, worth_table

    backends: tuple[BackendName, ...] = ("ekf", "graph") if graph else ("ekf",)
    _judge_each(
        "check fusion",
        (reading, paths, estimating, by, as_json),
        lambda model, recording, config, group: [
            worth_of(model, recording, config, group, backends)
        ],
        worth_table,
    )


@grouped
def fixes(
    paths: RecordingsArgument,
    reading: Reading,
    estimating: Estimating,
    every: Annotated[float, typer.Option(min=0.1, help="Seconds between two fixes.")] = 5.0,
    sigma: Annotated[float, typer.Option(min=0.001, help="Their error per axis \\[m].")] = 0.3,
    backend: BackendOption = "ekf",
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Give true positions now and then, and see whether position and yaw are as sure as said."""
    from stario.fusion.evaluation.checks.fixed import fixed_table, fixed_track

    _judge_each(
        "check fixes",
        (reading, paths, estimating, by, as_json),
        lambda model, recording, config, group: [
            fixed_track(model, recording, config, group, every, sigma, backend=backend)  # type: ignore[arg-type]
        ],
        fixed_table,
    )


@grouped
def gaps(
    paths: RecordingsArgument,
    reading: Reading,
    estimating: Estimating,
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Take 0.1 s out at six instants, then 5 % of the samples, and see how far the end moves."""
    from stario.fusion.evaluation.checks.missing import moved_ends, moved_table

    _judge_each("check gaps", (reading, paths, estimating, by, as_json), moved_ends, moved_table)


def _judge_each(
    title: str,
    given: tuple[Reading, Sequence[Path], Estimating, str, bool],
    judge: Judge,
    table: Callable[[Sequence[Any]], str],
) -> None:
    """Judge each recording, print the table or JSON, and leave with what could not be used."""
    from stario.fusion.evaluation.judging.judge import check_by, labels

    reading, paths, estimating, by, as_json = given
    grouping = check_by(by)
    model, settings = estimating.network(), estimating.settings()

    def judged(path: Path, sequence: ImuSequence) -> Sequence[Any]:
        return judge(model, sequence, settings, labels(path, sequence.attributes)[grouping])

    results, skipped = result_of_each(title, reading, paths, judged)
    found = [one for several in results for one in several]
    if as_json:
        print_json([asdict(one) for one in found])
    elif found:
        typer.echo(table(found))
    leave_with_skipped(skipped)
