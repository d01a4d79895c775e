"""`stario train` and `export`: networks trained, and for other runtimes."""

from __future__ import annotations

import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from stario.fusion.commands import common, options
from stario.sequences.datasets.batch import Skipped
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.network.model import DisplacementModel
    from stario.network.training.config import TrainingConfig
    from stario.network.training.data import RecordingStreams, TrainingData
    from stario.network.training.history import EpochReport
    from stario.sequences.windows import WorldStream

    Streams = tuple[list[RecordingStreams], list[Skipped]]


_GENERATED = 150
"""Default number of simulated walks."""

_CALIBRATING_S = 180.0
"""Length of held-out stretches with poses [s] below which sigma keeps the initial weights'
calibration: `first-stage` calibrated on 15 s of a person had an NIS of up to 22 on that person's
other recordings, on 80 s of up to 9, and with its own calibration of 2.8 to 5."""


@options.expanded
def train(
    context: typer.Context,
    reading: options.Reading,
    paths: options.OptionalPaths = None,
    model: str | None = typer.Option(
        None, help="Network to train, from `stario check models`. Default: that of --start-from."
    ),
    out: Path | None = typer.Option(
        None, help="Folder of the run, resumed if it holds a checkpoint. Default: runs/NETWORK."
    ),
    validation: list[Path] | None = typer.Option(
        None, help="Recordings to select and calibrate on. Default: the last fifth of each."
    ),
    data: Path | None = typer.Option(
        None,
        help="Folder of the development recordings: train on all that the package lists except "
        "the test recordings; select and calibrate on those of its list `holdout`.",
    ),
    learn_from: Literal["all", "open", "few"] = typer.Option(
        "all",
        help="With --data: all, those whose licence allows any use, or the eight recordings of "
        "the paper's comparison.",
    ),
    leave_out: list[str] | None = typer.Option(
        None,
        help="With --data: neither learn from this set or group nor select on it: tyrex, or "
        "'ridi dan'. Repeatable.",
    ),
    generated: int | None = typer.Option(
        None, min=0, help=f"Simulated walks of 60 s. Default: {_GENERATED}."
    ),
    recorded_only: bool = options.flag(
        False, "--recorded-only", help="Train without simulated walks."
    ),
    body: list[Path] | None = typer.Option(
        None,
        help="Motion capture (HDF5, also FILE:CLIP or FILE:'walk*', or BVH) to learn from virtual "
        "devices on; a share of the recipe may name the file. Repeatable.",
    ),
    config: Path | None = typer.Option(None, help="TOML or JSON file with recipe settings."),
    epochs: int | None = typer.Option(None, min=1, help="Epochs; overrides --config."),
    seed: int | None = typer.Option(None, min=0, help="Seed; overrides --config."),
    start_from: str | None = typer.Option(
        None,
        help="Weights to fine-tune: default, another name, or a safetensors file. Without "
        "--config they are changed only a little.",
    ),
    last_stage: str | None = typer.Option(
        None,
        help="Also train on the validation recordings; sigma takes the calibration of these "
        "weights, which were trained without them.",
    ),
    cache: options.Cache = None,
    jobs: int = typer.Option(
        1,
        min=1,
        help="Processes that read recordings into the cache; to train in several, use torchrun.",
    ),
) -> None:
    """Train a network on recordings with ground truth and on simulated walks; a rerun resumes.

    Ground truth may be poses, positions or waypoints. Use --start-from default to fine-tune the
    default weights on your own walks. All networks share one recipe. In several processes:
    torchrun --nproc-per-node 2 --no-python stario train ...
    """
    from stario.network.model import load_model
    from stario.network.training.config import INSERTED
    from stario.network.training.data import recording_streams, seconds_of
    from stario.network.training.made import moment_streams, virtual_recordings
    from stario.network.training.parallel import is_leader
    from stario.network.training.splits import warn_of_learned
    from stario.network.training.train import train as train_network
    from stario.sequences.datasets.stream_cache import cache_folder
    from stario.sequences.datasets.stream_cache import recorded as recorded_streams
    from stario.sequences.files import make_folder

    if recorded_only and generated:
        raise InputError("--generated", "use with --recorded-only", "one of the two")
    walks = 0 if recorded_only else _GENERATED if generated is None else generated
    first = load_model(start_from) if start_from else None  # fails before anything slow starts
    if first is not None:
        _ = first.training_form  # an exported graph has none
    recipe = _recipe(config, first, architecture=model, epochs=epochs, seed=seed)
    _check_sources(context, paths, validation, data, generated)
    folder = cache or cache_folder()
    lists = packaged_lists(data, leave_out or [], learn_from)
    if data is not None and (judged := last_stage or start_from):
        warn_of_learned([judged], lists[1], data)

    def streams_of(files: list[Path]) -> Streams:
        given = reading.read, reading.as_read(), folder, jobs, recipe.attitude
        outcomes = zip(files, recorded_streams(files, *given), strict=True)
        return recording_streams(common.with_bar("read", outcomes, len(files)))

    recorded, held_out, skipped = _recorded(
        reading, paths or [], validation or [], lists, streams_of
    )
    out = out or Path("runs") / recipe.architecture
    make_folder(out)
    virtual = virtual_recordings(body or [], recipe.seed, folder)
    learned = recorded + virtual + (held_out if last_stage is not None else [])
    held = _validation(held_out, bool(recorded), recipe, folder)
    if walks and is_leader():
        typer.echo(
            f"simulating {walks} walks of a minute, or reading them from the cache", err=True
        )
    moments = []
    if recipe.shares.get(INSERTED):
        real = [recording.path for recording in learned if recording.has_poses]
        moments = moment_streams(real, reading.read, reading.as_read(), recipe.seed, folder)
    material = _material(learned, walks, moments, recipe, folder)
    calibrates = not held.simulated and seconds_of(held.streams) >= _CALIBRATING_S
    calibrated_by = last_stage or (None if calibrates else start_from)
    calibration = load_model(calibrated_by).card.calibration if calibrated_by else None
    if is_leader():
        common.list_skipped(skipped)  # before hours of training
        for words in material.words:
            typer.echo(words, err=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # which would end without a word
    try:
        with common.training_progress(recipe.steps, shown=is_leader()) as progress:
            path = train_network(
                recipe, material, held, out, progress, _print_epoch, first, calibration
            )
    except KeyboardInterrupt:
        typer.echo(f"stopped; the same command goes on from the last epoch in {out}", err=True)
        raise
    if is_leader():
        typer.echo(str(path))
        if skipped:
            raise typer.Exit(1)


def _check_sources(
    context: typer.Context,
    paths: list[Path] | None,
    validation: list[Path] | None,
    data: Path | None,
    generated: int | None,
) -> None:
    """Refuse options that nothing uses, and a run without anything to learn from."""
    if data is not None:
        options.refuse(context, "with --data", "use with PATH: name the archive", "where")
        return
    needed = "use with the development recordings"
    options.refuse(context, "without --data", needed, "leave_out", "learn_from")
    if not paths and not validation:
        options.refuse(context, "without recordings", "use with PATH", *options.READING)
    if not paths and generated is None:
        raise InputError("PATH", "none", "recordings, --data, or --generated for walks only")


def packaged_lists(
    data: Path | None, left_out: list[str], name: str
) -> tuple[list[Path], list[Path]]:
    """Return the training and held-out recordings from the lists in the package.

    Without a folder there are none. Sets or groups are left out of both; the list is all, open or
    few.

    Raises:
        InputError: a group does not exist.
    """
    from stario.network.training.splits import read_packaged_list, without_holdout
    from stario.sequences.datasets.splits import hold_out_group

    if data is None:
        return [], []
    everything = (
        read_packaged_list("training", data) + read_packaged_list("validation", data)
        if name == "few"
        else read_packaged_list(name, data)
    )
    for group in left_out:
        everything, _ = hold_out_group(everything, group)
    outside, inside = without_holdout(everything, data)
    return [entry.path for entry in outside], [entry.path for entry in inside]


def _recorded(
    reading: options.Reading,
    paths: list[Path],
    validation: list[Path],
    lists: tuple[list[Path], list[Path]],
    streams_of: Callable[[list[Path]], Streams],
) -> tuple[list[RecordingStreams], list[RecordingStreams], list[Skipped]]:
    """Return training, held-out and skipped recordings; exit at once if too few are usable.

    Without any to hold out, the last fifth of each is; `lists` names further ones of both kinds.
    """
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
        common.exit_if_skipped(skipped)
    if held_files or not files:
        return recordings, held_out, skipped
    return *split_off(recordings), skipped


def _material(
    recorded: list[RecordingStreams],
    walks: int,
    moments: list[WorldStream],
    recipe: TrainingConfig,
    folder: Path,
) -> TrainingData:
    """Return what is learned from, if anything has full ground truth."""
    from stario.network.training.data import mix_sources
    from stario.network.training.made import cached_walks

    simulated = cached_walks(walks, recipe.seed, folder, recipe.attitude)
    material = mix_sources(recorded, simulated, recipe.shares, recipe.reach, moments)
    if not walks and material.legs and not material.streams:
        raise InputError(
            "simulated walks",
            "none, and only positions or waypoints to learn from",
            "some recordings with poses",
            "omit --recorded-only: the poses of simulated walks will do",
        )
    return material


def _validation(
    recorded: list[RecordingStreams], required: bool, recipe: TrainingConfig, folder: Path
) -> TrainingData:
    """Return what is selected and calibrated on, if there is any or none is required."""
    from stario.network.training.data import validation_data
    from stario.network.training.made import cached_walks

    if required and not any(recording.streams for recording in recorded):
        raise InputError(
            "recordings",
            "none whose last fifth has 2 s of poses, or two legs between known positions",
            "validation data to select and calibrate on",
            "name recordings with --validation",
        )
    walks = partial(cached_walks, 10, recipe.seed + 1, folder, recipe.attitude)
    return validation_data(recorded, walks)


def _print_epoch(report: EpochReport) -> None:
    words = f"initial weights: validation {report.validation_error:.4f} m^2"
    if report.epoch:
        words = (
            f"epoch {report.epoch}: training {report.training_error:.4f} m^2, "
            f"validation {report.validation_error:.4f} m^2; {report.windows_per_second:.0f} "
            f"windows/s, {report.drawing_share:.0%} of the time spent drawing them"
        )
    typer.echo(words, err=True)


def _recipe(
    path: Path | None, first: DisplacementModel | None, **over: int | str | None
) -> TrainingConfig:
    from stario.network.training.config import FINE_TUNING, training_config
    from stario.sequences.settings import naming, read_settings

    values = {} if first is None else FINE_TUNING
    if path is not None:
        values = read_settings(path)
        with naming(path):
            training_config(values)
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


def export(
    model: str = typer.Option(
        "default",
        help="Network: a name from `stario check models`, default, or weights with their card.",
    ),
    runs: Path = typer.Option(
        Path("runs"), help="Folder of training runs in which named networks are found."
    ),
    out: Path | None = typer.Option(None, help="File to write. Default: ./NETWORK.onnx"),
) -> None:
    """Export a network with its calibration as ONNX; `--model FILE.onnx` then runs it anywhere."""
    from stario.network.model import load_model, weights_named
    from stario.network.runtime.export import export_onnx

    loaded = load_model(weights_named(model, runs))
    path = out or Path(f"{loaded.name}.onnx")
    if path.suffix != ".onnx":
        raise InputError("--out", str(path), "a name ending in .onnx")
    export_onnx(loaded, path)
    typer.echo(str(path))
