"""`stario check models`: cost of each network."""

from __future__ import annotations

from typing import Annotated

import typer

from stario.fusion.commands.common import print_json, progress_bar
from stario.fusion.commands.options import JsonOption


def models(
    names: Annotated[
        list[str] | None, typer.Argument(help="Networks. Default: all of the paper's table.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List parameters, FLOPs, time and memory of each network next to the paper's values."""
    from stario.network.architectures import ARCHITECTURES
    from stario.network.runtime.survey import survey, survey_table
    from stario.sequences.datasets.stream_cache import cache_folder

    with progress_bar("models") as progress:
        rows = survey(names or list(ARCHITECTURES), cache_folder(), progress)
    if as_json:
        print_json([row.as_dict() for row in rows])
        return
    typer.echo(survey_table(rows))
