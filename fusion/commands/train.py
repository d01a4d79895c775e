"""`stario train`: train a network on recordings and simulated walks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import (
    exit_if_skipped,
    list_skipped,
    progress_bar,
    with_bar,
)
from stario.fusion.commands.options import (
    CacheOption,
    JobsOption,
    OptionalPathsArgument,
    ReadingOptions,
    changed,
    expand_option_groups,
    recipe_values,
    refuse_unused,
)
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.network.model import DisplacementModel
    from stario.network.training.config import TrainingConfig
    from stario.network.training.data import RecordingStreams
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.windows import Attitude


_GENERATED = 150
"""Default number of simulated walks."""


@expand_option_groups
def train(
    reading: ReadingOptions,
    paths: OptionalPathsArgument = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Network to train, from `stario check models`. Default: that of --start-from."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the run, resumed if it holds a checkpoint. Default: runs/NETWORK."
        ),
    ] = None,
    validation: Annotated[
        list[Path] | None,
        typer.Option(
            help="Recordings to select and calibrate on. Default: the last fifth of each."
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the development recordings: train on all that the package lists except "
            "the test recordings; select and calibrate on those of its list `holdout`."
        ),
    ] = None,
    learn_from: Annotated[
        str,
        typer.Option(
            help="With --data: all, open (those whose licence allows any use) or few (the eight "
            "recordings of the paper's comparison)."
        ),
    ] = "all",
    leave_out: Annotated[
        str | None,
        typer.Option(help="With --data: hold out this group instead, such as 'tyrex Thibaud'."),
    ] = None,
    generated: Annotated[
        int | None, typer.Option(min=0, help=f"Simulated walks of 60 s. Default: {_GENERATED}.")
    ] = None,
    recorded_only: Annotated[
        bool, typer.Option("--recorded-only", help="Train without simulated walks.")
    ] = False,
    config: Annotated[Path | None, typer.Option(help="JSON file with recipe settings.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs; overrides --config.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed; overrides --config.")] = None,
    start_from: Annotated[
        str | None,
        typer.Option(
            help="Weights to fine-tune: default, another name, or a safetensors file. Without "
            "--config they are changed only a little."
        ),
    ] = None,
    last_stage: Annotated[
        str | None,
        typer.Option(
            help="Also train on the validation recordings; sigma takes the calibration of these "
            "weights, which were trained without them.",
        ),
    ] = None,
    cache: CacheOption = None,
    jobs: JobsOption = 1,
) -> None:
    """Train a network on recordings with ground truth and on simulated walks; a rerun resumes.

    Ground truth may be poses, positions or waypoints. Use --start-from default to fine-tune the
    default weights on your own walks. All networks share one recipe. In several processes:
    torchrun --nproc-per-node 2 --no-python stario train ...
    """
    from stario.fusion.evaluation.folders import make_folder
    from stario.network.model import load_model
    from stario.network.training.data import cached_walks, mix_sources
    from stario.network.training.parallel import is_leader
    from stario.network.training.train import train as train_network
    from stario.sequences.datasets.stream_cache import cache_folder

    if recorded_only:
        refuse_unused({"--generated": bool(generated)}, "with --recorded-only", "one of the two")
    if data is not None:
        refuse_unused(changed(reading, "where"), "with --data", "use with PATH: name the archive")
    elif not paths and not validation:
        refuse_unused(changed(reading), "without recordings", "use with PATH")
    first = load_model(start_from) if start_from else None  # fails before anything slow starts
    if first is not None:
        _ = first.training_form  # an exported graph has none
    recipe = _recipe(config, first, architecture=model, epochs=epochs, seed=seed)
    if not paths and data is None and generated is None:
        raise InputError("PATH", "none", "recordings, --data, or --generated for walks only")
    walks = 0 if recorded_only else _GENERATED if generated is None else generated
    folder = cache or cache_folder()
    streams_of = partial(_streams_of, reading, recipe.attitude, folder, jobs)
    recorded, held_out, skipped = _recorded(
        reading, paths or [], validation or [], _lists(data, leave_out, learn_from), streams_of
    )
    out = out or Path("runs") / recipe.architecture
    make_folder(out)
    material = mix_sources(
        recorded + held_out if last_stage is not None else recorded,
        cached_walks(walks, recipe.seed, folder, recipe.attitude),
        recipe.shares,
        recipe.reach,
    )
    if recorded_only and material.legs and not material.streams:
        raise InputError(
            "--recorded-only",
            "only positions or waypoints to learn from",
            "some recordings with poses",
            "omit it: the poses of simulated walks will do",
        )
    validation_data = mix_sources(held_out, [])
    if recorded and not (validation_data.streams or validation_data.legs):
        raise InputError(
            "recordings",
            "none whose last fifth has 2 s of poses, or two legs between known positions",
            "validation data to select and calibrate on",
            "name recordings with --validation",
        )
    calibrated_by = last_stage or (None if validation_data.streams else start_from)
    # Sigma needs windows with full ground truth; if there are none, use simulated walks.
    windows = validation_data.streams or cached_walks(10, recipe.seed + 1, folder, recipe.attitude)
    if is_leader():
        list_skipped(skipped)  # before hours of training
        for words in material.words:
            typer.echo(words, err=True)
    with progress_bar("train", total=recipe.steps, shown=is_leader()) as progress:
        path = train_network(
            recipe,
            material.streams,
            material.weights,
            windows,
            out,
            on_step=lambda step, error: progress(step / recipe.steps),
            on_epoch=lambda report: typer.echo(
                f"epoch {report.epoch}: training {report.training_error:.4f} m^2, "
                f"validation {report.validation_error:.4f} m^2; "
                f"{report.windows_per_second:.0f} windows/s, {report.drawing_share:.0%} of the "
                "time spent drawing them",
                err=True,
            ),
            trained_on=material.words,
            start_from=first,
            calibration=load_model(calibrated_by).card.calibration if calibrated_by else None,
            legs=material.legs,
            validation_legs=validation_data.legs,
            chosen_by_legs=not validation_data.streams,
        )
    if is_leader():
        typer.echo(str(path))
        if skipped:
            raise typer.Exit(1)


def _recipe(
    path: Path | None, first: DisplacementModel | None, **over: int | str | None
) -> TrainingConfig:
    from stario.network.training.config import FINE_TUNING, training_config

    values = {} if first is None else FINE_TUNING
    if path is not None:
        values = recipe_values(path)
    if first is not None:
        values = {"architecture": first.card.architecture, **values}
    recipe = training_config(values | {k: v for k, v in over.items() if v is not None})
    if first is not None and first.card.architecture != recipe.architecture:
        raise InputError(
            "--start-from",
            f"weights of {first.card.architecture}",
            recipe.architecture,
            "omit --model, or name weights of that network",
        )
    return recipe


def _lists(data: Path | None, group: str | None, name: str) -> tuple[list[Path], list[Path]]:
    """Return the training and held-out recordings from the lists in the package."""
    from stario.network.training.splits import read_packaged_list, without_holdout
    from stario.sequences.arrays import check_choice
    from stario.sequences.datasets.splits import hold_out_group

    if data is None:
        unused = {"--leave-out": group is not None, "--learn-from": name != "all"}
        refuse_unused(unused, "without --data", "use with the development recordings")
        return [], []
    check_choice("--learn-from", name, ("all", "open", "few"))
    everything = (
        read_packaged_list("training", data) + read_packaged_list("validation", data)
        if name == "few"
        else read_packaged_list(name, data)
    )
    if group is not None:
        outside, inside = hold_out_group(everything, group)
    else:
        outside, inside = without_holdout(everything, data)
    return [entry.path for entry in outside], [entry.path for entry in inside]


def _recorded(
    reading: ReadingOptions,
    paths: list[Path],
    validation: list[Path],
    lists: tuple[list[Path], list[Path]],
    streams_of: Callable[[list[Path]], tuple[list[RecordingStreams], list[Skipped]]],
) -> tuple[list[RecordingStreams], list[RecordingStreams], list[Skipped]]:
    """Return training, held-out and skipped recordings; exit at once if too few are usable."""
    from stario.network.training.data import split_off

    files, missing = reading.recordings(paths)
    held_files, held_missing = reading.recordings(validation)
    files, held_files = files + lists[0], held_files + lists[1]
    known = {path.resolve() for path in held_files}
    if both := [path for path in files if path.resolve() in known]:  # would hide overfitting
        raise InputError(
            "--validation", f"{both[0]}, which is also trained on", "other recordings",
            "remove it; without --validation the last fifth of each recording is held out",
        )  # fmt: skip
    recordings, failed = streams_of(files)
    held_out, held_failed = streams_of(held_files)
    skipped = missing + failed + held_missing + held_failed
    if skipped and not (recordings and (held_out or not validation)):
        exit_if_skipped(skipped)
    if held_files or not files:
        return recordings, held_out, skipped
    return *split_off(recordings), skipped


def _streams_of(
    reading: ReadingOptions, attitude: Attitude, folder: Path, jobs: int, files: list[Path]
) -> tuple[list[RecordingStreams], list[Skipped]]:
    from stario.network.training.data import recording_streams
    from stario.sequences.datasets.stream_cache import recorded

    outcomes = recorded(files, reading.read, reading.as_read(), folder, jobs, attitude)
    return recording_streams(with_bar("read", zip(files, outcomes, strict=True), len(files)))
