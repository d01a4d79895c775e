"""`stario check consistency`: are the filter's errors consistent with its covariance?"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import print_json, progress_bar
from stario.fusion.commands.options import JsonOption


def consistency(
    config: Annotated[
        Path | None,
        typer.Option("--config", help="TOML or JSON file with settings."),
    ] = None,
    yaw: Annotated[float, typer.Option(min=0.0, help="Sigma of the initial yaw in deg.")] = 10.0,
    runs: Annotated[int, typer.Option(min=1, help="Number of simulated walks.")] = 20,
    seconds: Annotated[float, typer.Option(min=2.0, help="Duration of each walk in s.")] = 300.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first walk.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Run a Monte Carlo test on simulated walks: are NEES, NIS and yaw error consistent?"""
    from stario.fusion.config import NavigatorConfig, read_config
    from stario.fusion.evaluation.checks.consistency import consistency as monte_carlo

    checked = read_config(config) if config else NavigatorConfig()
    with progress_bar("consistency") as progress:
        result = monte_carlo(checked, max(math.radians(yaw), 1e-6), runs, seconds, seed, progress)
    if as_json:
        print_json(asdict(result))
        return
    for line in result.lines():
        typer.echo(line)
