"""`stario check gaps`: how far a track's end moves where samples are missing."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import leave_with_skipped, print_json, result_of_each
from stario.fusion.commands.options import ByOption, Estimating, JsonOption, Reading, grouped

if TYPE_CHECKING:
    from stario.fusion.evaluation.missing import Moved
    from stario.sequences.sequence import ImuSequence


@grouped
def gaps(
    paths: Annotated[list[Path], typer.Argument(help="Recordings, folders, archives or lists.")],
    reading: Reading,
    estimating: Estimating,
    by: ByOption = "set",
    as_json: JsonOption = False,
) -> None:
    """Take 0.1 s out at six instants, then 5 % of the samples, and see how far the end moves."""
    from stario.fusion.evaluation.judging import check_by, labels
    from stario.fusion.evaluation.missing import moved_ends, moved_table

    grouping = check_by(by)
    model, settings = estimating.network(), estimating.settings()

    def moved(path: Path, sequence: ImuSequence) -> list[Moved]:
        group = labels(path, sequence.attributes)[grouping]
        return moved_ends(model, sequence, settings, group)

    found, skipped = result_of_each("check gaps", reading, paths, moved)
    ends = [one for ends in found for one in ends]
    if as_json:
        print_json([asdict(one) for one in ends])
    elif ends:
        typer.echo(moved_table(sorted(ends, key=lambda one: one.group)))
    leave_with_skipped(skipped)
