"""`stario compare`: all tracks of recordings side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands.common import (
    Estimating,
    FixesOption,
    JsonOption,
    OutOption,
    PathsArgument,
    Reading,
    distinct,
    found,
    grouped,
    print_json,
    progress_bar,
    track_table,
)
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.compare import Comparison


@grouped
def compare(
    reading: Reading,
    estimating: Estimating,
    paths: PathsArgument = None,
    fixes: FixesOption = None,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare tracks: inertial alone, network alone, EKF. Without PATH: a simulated walk."""
    from stario.fusion.compare import compare as compare_tracks
    from stario.fusion.compare import demonstration
    from stario.fusion.fixes import read_fixes
    from stario.fusion.results import comparison_dict, write_comparison

    settings, network = estimating.settings(), estimating.network()
    if paths:
        files = found(paths)
        sequences = distinct(reading.read(file) for file in files)
    else:
        typer.echo("demonstration: a simulated walk that training never saw", err=True)
        sequences = [demonstration()]
    if fixes is not None and len(sequences) > 1:
        raise InputError("--fixes", f"{len(sequences)} recordings", "one recording")
    known = [] if fixes is None else read_fixes(fixes)
    comparisons = []
    for sequence in sequences:
        with progress_bar(f"compare {sequence.name}") as progress:
            comparisons.append(compare_tracks(network, sequence, settings, progress, known))
    folder = out or Path("runs") / "compare"
    written = write_comparison(folder, comparisons, settings)
    if as_json:
        print_json(comparison_dict(comparisons))
        return
    for comparison in comparisons:
        _print_comparison(comparison)
    typer.echo(f"{len(written)} files in {folder}")


def _print_comparison(comparison: Comparison) -> None:
    sequence = comparison.sequence
    path = comparison.path_m
    way = "no truth" if path is None else f"{path:.1f} m"
    typer.echo(f"{sequence.name}: {sequence.duration:.1f} s, {way}")
    typer.echo(track_table(comparison.metrics))
