"""`stario check fusion`: what the fusion is worth against its network, by groups of recordings."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import leave_with_skipped, print_json, result_of_each
from stario.fusion.commands.options import ByOption, Estimating, JsonOption, Reading, grouped

if TYPE_CHECKING:
    from stario.fusion.evaluation.worth import Worth
    from stario.sequences.sequence import ImuSequence


@grouped
def fusion(
    paths: Annotated[list[Path], typer.Argument(help="Recordings, folders, archives or lists.")],
    reading: Reading,
    estimating: Estimating,
    by: ByOption = "set",
    graph: Annotated[bool, typer.Option("--graph", help="The graph as well; slower.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Hold the filter's error against its network's, with NIS and honesty of the yaw, by group."""
    from stario.fusion.backends import BackendName
    from stario.fusion.evaluation.judging import check_by, labels
    from stario.fusion.evaluation.worth import worth_of, worth_table

    grouping = check_by(by)
    model, settings = estimating.network(), estimating.settings()
    backends: tuple[BackendName, ...] = ("ekf", "graph") if graph else ("ekf",)

    def judged(path: Path, sequence: ImuSequence) -> Worth:
        group = labels(path, sequence.attributes)[grouping]
        return worth_of(model, sequence, settings, group, backends)

    found, skipped = result_of_each("check fusion", reading, paths, judged)
    if as_json:
        print_json([asdict(one) for one in found])
    elif found:
        typer.echo(worth_table(sorted(found, key=lambda one: one.group)))
    leave_with_skipped(skipped)
