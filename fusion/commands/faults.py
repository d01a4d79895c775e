"""`stario check faults`: errors that faults in a recording cause."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import print_json
from stario.fusion.commands.options import (
    EstimatorOptions,
    JsonOption,
    ReadingOptions,
    expand_option_groups,
)


@expand_option_groups
def faults(
    reading: ReadingOptions,
    estimating: EstimatorOptions,
    path: Annotated[
        Path | None,
        typer.Argument(help="Recording with true poses. Default: a simulated walk."),
    ] = None,
    network: Annotated[
        bool,
        typer.Option(
            "--network",
            help="Use the network's displacements instead of true ones with white noise.",
        ),
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the faults and of the simulated walk, if any.")
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Inject faults into a recording one at a time; print the resulting error and the report."""
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
