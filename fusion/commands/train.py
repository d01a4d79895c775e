"""`stario train`: a network from recordings and simulated walks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stario.fusion.commands.common import PathsArgument, Reading, found, grouped, progress_bar
from stario.sequences.errors import ConfigError, InputError

if TYPE_CHECKING:
    from stario.network.train import TrainingConfig
    from stario.sequences.windows import WorldStream


@grouped
def train(
    reading: Reading,
    paths: PathsArgument = None,
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run, resumed if it holds a checkpoint.")
    ] = Path("runs/train"),
    validation: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings that choose and calibrate; else the last fifth of each."),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the development recordings: split and walks.")
    ] = None,
    captured: Annotated[
        Path | None, typer.Option(help="Captured trajectories (npz) to drive a simulated IMU.")
    ] = None,
    generated: Annotated[int, typer.Option(min=0, help="Number of generated walks of 60 s.")] = 150,
    config: Annotated[
        Path | None, typer.Option("--config", help="JSON file with settings of the recipe.")
    ] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs, over the file's.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, over the file's.")] = None,
    start_from: Annotated[
        str | None, typer.Option(help="Weights to start from: default, or a safetensors file.")
    ] = None,
    last_stage: Annotated[
        bool,
        typer.Option(
            "--last-stage",
            help="Learn from the validation recordings too, keep the calibration of --start-from.",
        ),
    ] = False,
) -> None:
    """Train a network on recordings with truth and on simulated walks; resumes by itself."""
    from stario.network.data import captured_streams, gather, generated_streams
    from stario.network.model import load_model
    from stario.network.train import train as train_network
    from stario.sequences.vicon import read_vicon_walks

    recipe = _recipe(config, epochs=epochs, seed=seed)
    if last_stage and start_from is None:
        raise InputError("--last-stage", "no --start-from", "the weights whose calibration is kept")
    recorded, held_out = _training_recordings(reading, paths or [], validation or [], data)
    walks = captured or (data / "walks/oxiod_vicon.npz" if data else None)
    material = gather(
        recorded + held_out if last_stage else recorded,
        captured_streams(read_vicon_walks(walks), recipe.seed) if walks else [],
        generated_streams(generated, 60.0, recipe.seed),
    )
    held_out = held_out or generated_streams(10, 60.0, recipe.seed + 1)
    for words in material.words:
        typer.echo(words, err=True)
    with progress_bar("train", total=recipe.steps) as progress:
        path = train_network(
            recipe,
            material.streams,
            material.weights,
            held_out,
            out,
            on_step=lambda step, error: progress(step / recipe.steps),
            on_epoch=lambda report: typer.echo(
                f"epoch {report.epoch}: training {report.training_error:.4f} m^2, "
                f"validation {report.validation_error:.4f} m^2",
                err=True,
            ),
            trained_on=material.words,
            start_from=load_model(start_from) if start_from else None,
            keep_calibration=last_stage,
        )
    typer.echo(str(path))


def _recipe(path: Path | None, **over: int | None) -> TrainingConfig:
    from stario.network.train import training_config

    values: dict[str, Any] = {}
    if path is not None:
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(str(path), str(error), "a JSON file with settings") from error
        if not isinstance(values, dict):
            raise ConfigError(str(path), type(values).__name__, "a table of settings")
    return training_config(values | {k: v for k, v in over.items() if v is not None})


def _training_recordings(
    reading: Reading, paths: list[Path], validation: list[Path], data: Path | None
) -> tuple[list[WorldStream], list[WorldStream]]:
    from stario.network.data import recorded_streams
    from stario.sequences.splits import split_paths

    training_files, validation_files = found(paths), found(validation)
    if data is not None:
        training_files += split_paths(data, "training")
        validation_files += split_paths(data, "validation")
    sequences = [reading.read(p) for p in training_files]
    if validation_files or not sequences:
        held_out = [reading.read(p) for p in validation_files]
        return recorded_streams(sequences), recorded_streams(held_out)
    cuts = [s.time[0] + 0.8 * s.duration for s in sequences]
    first = [s.slice(s.time[0], cut) for s, cut in zip(sequences, cuts, strict=True)]
    last = [s.slice(cut, s.time[-1]) for s, cut in zip(sequences, cuts, strict=True)]
    return recorded_streams(first), recorded_streams(last)
