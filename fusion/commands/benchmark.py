"""`stario check benchmark`: speed on this machine."""

from __future__ import annotations

import typer

from stario.fusion.commands.common import print_json
from stario.fusion.commands.options import JsonOption


def benchmark(as_json: JsonOption = False) -> None:
    """Measure speed on this machine: filter against dense algebra, network, whole run."""
    from stario.fusion.evaluation.checks.speed import speed_report, speed_table
    from stario.network.model import load_model

    report = speed_report(load_model("default"))
    if as_json:
        print_json(report)
        return
    typer.echo(speed_table(report))
