"""`stario check faults`: what faults in a recording cost."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import print_json
from stario.fusion.commands.options import Estimating, JsonOption, Reading, grouped


@grouped
def faults(
    reading: Reading,
    estimating: Estimating,
    path: Annotated[
        Path | None, typer.Argument(help="A recording with truth; else a walk, its sensor known.")
    ] = None,
    network: Annotated[
        bool,
        typer.Option(
            "--network",
            help="Let the network measure; else the true displacements under white noise do.",
        ),
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, help="Of the faults' draws, and of the walk where none is given.")
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Put faults into a recording, one by one, and print what each costs and what is reported."""
    from stario.fusion.evaluation.checks.faults import fault_table, matched_walk, run_faults

    settings = estimating.settings()
    if path is not None:
        sequence = reading.read(path)
    else:
        sequence, matched = matched_walk(seed=seed)
        settings = matched if estimating.config is None else settings
    results = run_faults(sequence, settings, estimating.network() if network else None, seed)
    if as_json:
        print_json({"recording": sequence.name, "faults": [asdict(r) for r in results]})
        return
    typer.echo(f"{sequence.name}: {sequence.duration:.1f} s")
    typer.echo(fault_table(results))
