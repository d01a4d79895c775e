"""`stario convert`: any readable recording into a CSV or the EuRoC layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import Reading, grouped


@grouped
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A recording in any format.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File or new folder to write.")],
    reading: Reading,
    to: Annotated[
        str | None, typer.Option(help="csv or euroc; by default csv if OUT ends in .csv.")
    ] = None,
) -> None:
    """Convert a recording to a CSV or to the EuRoC layout, without loss."""
    from stario.sequences.convert import convert as convert_sequence

    sequence = reading.read(source)
    written = convert_sequence(sequence, target, to)
    typer.echo(f"{sequence.name}: {len(sequence)} samples, {sequence.duration:.1f} s")
    typer.echo("\n".join(str(path) for path in written))
