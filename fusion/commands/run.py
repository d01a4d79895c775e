"""`stario run`: one recording into a fused track."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import (
    Estimating,
    FixesOption,
    JsonOption,
    OutOption,
    Reading,
    grouped,
    print_json,
    progress_bar,
    track_table,
)


@grouped
def run(
    path: Annotated[Path, typer.Argument(help="A recording: a file, or a recording's folder.")],
    reading: Reading,
    estimating: Estimating,
    fixes: FixesOption = None,
    backend: Annotated[str, typer.Option(help="What fuses: ekf, or graph.")] = "ekf",
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fuse one recording into a track with attitude, velocity, biases and covariance."""
    from stario.fusion.compare import measure
    from stario.fusion.fixes import read_fixes
    from stario.fusion.navigator import Navigator
    from stario.fusion.results import write_run
    from stario.sequences.metrics import align

    settings, network = estimating.settings(), estimating.network()
    sequence = reading.read(path)
    navigator = Navigator(network, settings, backend=backend)  # type: ignore[arg-type]
    known = [] if fixes is None else read_fixes(fixes)
    with progress_bar(f"run {sequence.name}") as progress:
        track = navigator.run(sequence, progress, known)
    truth = sequence.truth
    metrics = measure(track, truth)
    folder = out or Path("runs") / sequence.name
    aligned = track.trajectory if truth is None else align(track.trajectory, truth, "first")
    written = write_run(
        folder, sequence.name, track, truth, aligned, metrics, settings, navigator.backend
    )
    if as_json:
        print_json({"recording": sequence.name, backend: metrics, "folder": str(folder)})
        return
    way = f"{sequence.name}: {sequence.duration:.1f} s, {track.trajectory.path_length():.1f} m"
    typer.echo(f"{way} travelled by the estimate")
    if truth is not None:
        typer.echo(track_table({backend: metrics}))
    for line in track.health.lines() if track.health else []:
        typer.echo(line)
    typer.echo(f"{len(written)} files in {folder}")
