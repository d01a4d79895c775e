"""What `stario train` learns from: recordings, lists, simulated walks, and what is held out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.network.training.config import TrainingConfig
    from stario.network.training.data import RecordingStreams, TrainingData
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.windows import Attitude


def packaged_lists(
    data: Path | None, left_out: list[str], name: str
) -> tuple[list[Path], list[Path]]:
    """Return the training and held-out recordings from the lists in the package.

    Args:
        data: folder of the development recordings; None for no recordings at all.
        left_out: sets or groups that are neither learned from nor selected on.
        name: all, open or few.

    Raises:
        InputError: a list or group does not exist.
    """
    from stario.network.training.splits import read_packaged_list, without_holdout
    from stario.sequences.arrays import check_choice
    from stario.sequences.datasets.splits import hold_out_group

    if data is None:
        return [], []
    check_choice("--learn-from", name, ("all", "open", "few"))
    everything = (
        read_packaged_list("training", data) + read_packaged_list("validation", data)
        if name == "few"
        else read_packaged_list(name, data)
    )
    for group in left_out:
        everything, _ = hold_out_group(everything, group)
    outside, inside = without_holdout(everything, data)
    return [entry.path for entry in outside], [entry.path for entry in inside]


def recorded_streams(
    reading: options.Reading,
    paths: list[Path],
    validation: list[Path],
    lists: tuple[list[Path], list[Path]],
    streams_of: Callable[[list[Path]], tuple[list[RecordingStreams], list[Skipped]]],
) -> tuple[list[RecordingStreams], list[RecordingStreams], list[Skipped]]:
    """Return training, held-out and skipped recordings; exit at once if too few are usable.

    Args:
        reading: how recordings are read and selected.
        paths: recordings to learn from.
        validation: recordings to hold out; without any, the last fifth of each is.
        lists: further recordings to learn from and to hold out.
        streams_of: reads files.

    Raises:
        InputError: a recording is both learned from and held out.
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


def streams_of_files(
    reading: options.Reading, attitude: Attitude, folder: Path, jobs: int, files: list[Path]
) -> tuple[list[RecordingStreams], list[Skipped]]:
    """Return the streams of files, cached in a folder, and the recordings that cannot be used."""
    from stario.network.training.data import recording_streams
    from stario.sequences.datasets.stream_cache import recorded

    outcomes = recorded(files, reading.read, reading.as_read(), folder, jobs, attitude)
    return recording_streams(common.with_bar("read", zip(files, outcomes, strict=True), len(files)))


def training_material(
    recorded: list[RecordingStreams], walks: int, recipe: TrainingConfig, folder: Path
) -> TrainingData:
    """Return what is learned from: recordings and a number of simulated walks.

    Raises:
        InputError: nothing has full ground truth.
    """
    from stario.network.training.data import cached_walks, mix_sources

    simulated = cached_walks(walks, recipe.seed, folder, recipe.attitude)
    material = mix_sources(recorded, simulated, recipe.shares, recipe.reach)
    if not walks and material.legs and not material.streams:
        raise InputError(
            "simulated walks",
            "none, and only positions or waypoints to learn from",
            "some recordings with poses",
            "omit --recorded-only: the poses of simulated walks will do",
        )
    return material


def validation_material(recorded: list[RecordingStreams], required: bool) -> TrainingData:
    """Return the validation data.

    Raises:
        InputError: there is none although it is required.
    """
    from stario.network.training.data import mix_sources

    held = mix_sources(recorded, [])
    if required and not (held.streams or held.legs):
        raise InputError(
            "recordings",
            "none whose last fifth has 2 s of poses, or two legs between known positions",
            "validation data to select and calibrate on",
            "name recordings with --validation",
        )
    return held
