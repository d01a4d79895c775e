"""Runs of the table: a network trained and tested on a data set with a seed, kept as files.

`<out>/<set>/<network>/<n>-steps/seed-<n>/` holds the model and `trained.json` once training is
done, then `tested.json`. Repeating a run adds only what is missing.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cache, lru_cache, partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd

from stario.fusion.evaluation.compare import TRACK_TITLES
from stario.fusion.evaluation.displacement_error import FIGURES, blocks_of
from stario.fusion.evaluation.groups import alone_on
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.pedestrian import (
    Model,
    PedestrianDeadReckoning,
    model_named,
    pedestrian_track,
)
from stario.fusion.evaluation.scores import LABELS, joined, scored
from stario.fusion.evaluation.tracks import network_track, network_track_true_attitude, true_poses
from stario.fusion.navigator import Navigator
from stario.fusion.paper_table.sets import ALL, FIRST, DataSet
from stario.network.architectures import ARCHITECTURES, architecture
from stario.network.model import load_model
from stario.network.training.config import TrainingConfig, training_config
from stario.network.training.data import (
    RecordingStreams,
    mix_sources,
    recording_streams,
    validation_data,
)
from stario.network.training.history import EpochReport, History
from stario.network.training.made import cached_walks
from stario.network.training.train import train
from stario.sequences.accuracy.metrics import PoseErrors, align, evaluate_track, pose_errors
from stario.sequences.arrays import check_choice
from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.datasets.stream_cache import recorded, recording_stamps
from stario.sequences.errors import ConfigError, InputError, ReadError
from stario.sequences.files import write_json
from stario.sequences.lazy import optional_package
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.windows import WINDOW_SAMPLES, Attitude

LEADING = ("StarIO", "R-ResNet", "DeepILS", "StarIO without MSGCU")
"""Networks that are completed first, and with several seeds."""

TRUE_ATTITUDE, OWN_ATTITUDE, FILTERED = "network_true_attitude", "network", "filtered"

PROTOCOLS = {name: TRACK_TITLES[name] for name in (TRUE_ATTITUDE, OWN_ATTITUDE, FILTERED)}
"""Tracks of a network and their titles; the first is that of the papers' protocol."""

Drawn = dict[str, FloatArray]
"""Time (N,) [s] of a track, horizontal positions `track` and `truth` (N, 2) [m]."""

MAX_DRAWN = 4
"""Number of recordings whose tracks are kept for a figure."""

_EPOCH_STEPS = 250
"""Maximum steps between two checkpoints: what an interrupted run loses."""

_VALIDATION_SAMPLES = 60 * WINDOW_SAMPLES
"""Maximum samples of each validation stretch: all are evaluated after every epoch."""

TEMPORARY_FILES = ("checkpoint.safetensors", "clock.json")
"""Files of a training run that are not needed once its result is recorded."""

_WALKS, _VALIDATION_WALKS = 40, 8
"""Simulated walks for training and validation windows where no recording has poses: the same for
every run, so that only the networks differ."""


@dataclass(frozen=True)
class ReaderConfig:
    """How recordings are read, on any machine that works on a run; told apart by the cache alone.

    Attributes:
        read: function that reads the recording at a path; must be picklable.
        options: what `read` depends on besides the path, as plain values.
        cache: folder that caches windows for later runs.
    """

    read: Callable[[Path], ImuSequence] = field(compare=False)
    options: dict[str, object] = field(compare=False)
    cache: Path


@dataclass(frozen=True)
class Run:
    """Definition of a run, as plain values that can be sent to any machine.

    Attributes:
        dataset: data set, with the recordings of each part.
        network: architecture to train, or `pdr`, or weights as `load_model` accepts them.
        seed: seed of the training.
        recipe: training recipe; None where nothing is trained.
    """

    dataset: DataSet
    network: str
    seed: int
    recipe: TrainingConfig | None

    def __str__(self) -> str:
        return f"{self.dataset.name}, {self.network}, seed {self.seed}"

    def folder(self, out: Path) -> Path:
        """Return its folder below `out`; each number of training steps has a folder of its own."""
        above = out / self.dataset.name / self.network.replace("/", "_")
        if self.recipe is None:
            return above
        return above / f"{self.recipe.steps}-steps" / f"seed-{self.seed}"

    @property
    def digest(self) -> str:
        """Digest of everything that its results depend on except the code."""
        test = [recording_state(entry.path) for entry in self.dataset.test]
        if self.recipe is not None:
            parts = (self.dataset.training, self.dataset.validation)
            states = [[*map(recording_state, part)] for part in parts]
            learned = _digest([asdict(self.recipe), states])
        else:
            learned = "" if self.network == PDR else _weights_sha256(self.network)
        return _digest([self.network, learned, test])


def _digest(inputs: object) -> str:
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def recording_state(path: Path) -> list[object]:
    """Return a recording's path and the stamps of its files, which tell that it has changed."""
    return [str(path), *recording_stamps(path)]


@cache
def _weights_sha256(name: str) -> str:
    return load_model(name).card.sha256


def complete_run(run: Run, out: Path, reading: ReaderConfig) -> Run:
    """Train and evaluate a run, except for what is already done.

    Every process that takes part must be able to write to `out`.

    Raises:
        ConfigError: existing results were made with another recipe, other weights or other
            recordings.
        InputError: the network cannot be trained.
    """
    folder = run.folder(out)
    if _read_if_done(run, folder / "tested.json") is not None:
        return run
    folder.mkdir(parents=True, exist_ok=True)
    if run.recipe is not None and _read_if_done(run, folder / "trained.json") is None:
        result = train_run(run.dataset, run.recipe, folder, reading)
        write_json(folder / "trained.json", {"cell": run.digest, **result})
        for spare in TEMPORARY_FILES:
            (folder / spare).unlink(missing_ok=True)
    began = process_time()
    trained = run.network in ARCHITECTURES
    model = load_model(folder / "model.safetensors") if trained else model_named(run.network)
    scores, blocks, drawn, skipped = test_scores(run, model, reading)
    content = {
        "cell": run.digest,
        "network": run.network,
        "seed": run.seed,
        "seconds": process_time() - began,
        "scores": scores.to_dict("list"),
        "blocks": blocks.to_dict("list"),
        "drawn": drawn,
        "skipped": [asdict(failure) for failure in skipped],
    }
    write_json(folder / "tested.json", content)
    return run


def train_run(
    dataset: DataSet, recipe: TrainingConfig, folder: Path, reading: ReaderConfig
) -> dict[str, object]:
    """Train a run's network, resuming from its checkpoint; write the model and `TEMPORARY_FILES`.

    Returns:
        Plain values: training error of the last epoch and validation error of the best one, whose
        weights are kept [m^2], number of steps, windows per second, computing time over all
        processes that continued the run in turn [s], the recipe, and the skipped recordings.

    Raises:
        InputError, ConfigError: as for `stario.network.training.train.train`.
    """
    streams, skipped = _streams(dataset.training, recipe.attitude, reading)
    held_out, missing = _streams(dataset.validation, recipe.attitude, reading)
    simulated = partial(cached_walks, folder=reading.cache, attitude=recipe.attitude)
    walks = [] if any(recording.has_poses for recording in streams) else simulated(_WALKS, 0)
    data = mix_sources(streams, walks, recipe.shares, recipe.reach)
    validation = validation_data(held_out, partial(simulated, _VALIDATION_WALKS, 1))
    began, clock = process_time(), folder / TEMPORARY_FILES[1]
    before = float(json.loads(clock.read_text())) if clock.exists() else 0.0  # of killed processes
    train(
        recipe,
        data,
        replace(validation, streams=[s.part(0, _VALIDATION_SAMPLES) for s in validation.streams]),
        folder,
        on_epoch=lambda report: write_json(clock, before + process_time() - began),
    )
    rows: list[dict[str, Any]] = json.loads((folder / "log.json").read_text(encoding="utf-8"))
    for row in rows:  # in JSON, errors that are not finite are null
        row.update({name: math.nan for name, value in row.items() if value is None})
    reports = [EpochReport(**row) for row in rows]
    return {
        "steps": recipe.steps,
        "windows_per_s": float(np.mean([report.windows_per_second for report in reports])),
        "seconds": before + process_time() - began,
        "training_error_m2": reports[-1].training_error,
        "validation_error_m2": History(recipe, reports).best().validation_error,
        "recipe": asdict(recipe),
        "skipped": [asdict(failure) for failure in skipped + missing],
    }


@lru_cache(maxsize=2)  # training and validation part of the set that runs are completed for
def _streams(
    files: tuple[Path, ...], attitude: Attitude, reading: ReaderConfig
) -> tuple[list[RecordingStreams], list[Skipped]]:
    """Return the streams of each recording; later runs of the same set reuse them."""
    outcomes = recorded(files, reading.read, reading.options, reading.cache, 1, attitude)
    return recording_streams(zip(files, outcomes, strict=True))


def completed_runs(runs: Iterable[Run], out: Path) -> dict[str, list[dict[str, Any]]]:
    """Return what the completed runs have in `tested.json` and in `trained.json`, by set.

    Raises:
        ConfigError: a run was completed with another recipe, other weights or other recordings.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        folder = run.folder(out)
        if (content := _read_if_done(run, folder / "tested.json")) is not None:
            if run.recipe is not None:
                content["trained"] = _read(folder / "trained.json")
            found.setdefault(run.dataset.name, []).append(content)
    return found


def test_scores(
    run: Run, model: Model, reading: ReaderConfig
) -> tuple[pd.DataFrame, pd.DataFrame, dict[str, Drawn], list[Skipped]]:
    """Return the errors on every test recording, and the recordings that were skipped.

    Returns:
        Scores with the labels `network` and `seed`, recordings named by their paths: figures of the
        network alone are those of a track that is called by the kind of truth; ATE, RTE and PDE are
        those of `PROTOCOLS`.
        Blocks of 30 s as of `alone_on`, and with the metric "ate" of the position error under the
        paper's protocol.
        For the first recordings with poses, what is drawn of the track with the true attitude.
    """
    groups = {entry.path: entry.group for entry in run.dataset.test}
    work = partial(_recording, network=run.network, model=model, read=reading.read, groups=groups)
    skipped: list[Skipped] = []
    scores = [pd.DataFrame(columns=[*LABELS, "path_m"])]
    blocks = [pd.DataFrame(columns=["squares", "count", "block", "metric", "set", *LABELS[:2]])]
    drawn: dict[str, Drawn] = {}
    for figures, squares, track in without_skipped(each(work, groups, 1), skipped):
        scores.append(figures)
        blocks.append(squares)
        if track and len(drawn) < MAX_DRAWN:
            drawn[figures["recording"].iloc[0]] = track
    of_run = {"network": run.network, "seed": run.seed}
    return *(joined(tables).assign(**of_run) for tables in (scores, blocks)), drawn, skipped


def _recording(
    path: Path,
    network: str,
    model: Model,
    read: Callable[[Path], ImuSequence],
    groups: Mapping[Path, str],
) -> tuple[pd.DataFrame, pd.DataFrame, Drawn]:
    sequence, drawn = read(path), {}
    found, blocks = alone_on(sequence, path, groups[path], lambda *_: model, [network])
    unit = found[["set", "group", "recording"]].iloc[0]
    scores = [found.assign(track=found["truth"])[[*LABELS, "path_m", *FIGURES]]]
    if sequence.truth is not None:
        tracks, poses = _protocol_errors(model, sequence)
        scores.append(scored(str(path), tracks, unit["group"]))
        if poses is not None:
            blocks = joined([blocks, _position_blocks(poses).assign(**unit)])
            estimate, truth = (each.position_W[:, :2] for each in (poses.estimate, poses.truth))
            drawn = {"time": poses.estimate.time, "track": estimate, "truth": truth}
    return joined(scores), blocks, drawn


def _position_blocks(poses: PoseErrors) -> pd.DataFrame:
    since, squares = poses.estimate.time - poses.estimate.time[0], poses.position_W[:, :2] ** 2
    errors = {"metric": "ate", "piece": 0, "second": since, "squares": squares.sum(axis=1)}
    return blocks_of(pd.DataFrame(errors))


def _protocol_errors(
    model: Model, sequence: ImuSequence
) -> tuple[dict[str, dict[str, float]], PoseErrors | None]:
    """Return the errors of the tracks of `PROTOCOLS`, and those of the poses of the first.

    Steps have the own attitude only.
    """
    truth = true_poses(sequence)
    if isinstance(model, PedestrianDeadReckoning):
        return {OWN_ATTITUDE: _errors_of(pedestrian_track(sequence).trajectory, truth)}, None
    navigator = Navigator(model, backend="ekf")
    preprocessed = navigator.observe(sequence)
    tracks = {
        TRUE_ATTITUDE: network_track_true_attitude(model, sequence, navigator.config).trajectory,
        OWN_ATTITUDE: network_track(preprocessed).trajectory,
        FILTERED: navigator.track(preprocessed).trajectory,
    }
    figures = {name: _errors_of(track, truth) for name, track in tracks.items()}
    return figures, pose_errors(align(tracks[TRUE_ATTITUDE], truth, "first"), truth)


def _errors_of(track: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Return the errors of a track, averaged as in the paper."""
    result = evaluate_track(track, truth, convention="ronin")
    return {"ate_m": result.ate_m, "rte_m": result.rte_m, "pde": result.pde}


def _read_if_done(run: Run, path: Path) -> dict[str, object] | None:
    content = _read(path) if path.exists() else None
    if content is not None and content.get("cell") != run.digest:
        raise ConfigError(
            str(path),
            "made with another recipe, other weights, or recordings that differ or changed since",
            "those of this table",
            "use what it was made with, remove it to make it anew, or use another folder (--out)",
        )
    return content


def _read(path: Path) -> dict[str, object]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReadError(path, "file", str(error), "a complete JSON file") from error
    assert isinstance(content, dict)  # written only by this module
    return content


def table_runs(
    sets: Sequence[DataSet],
    recipe: dict[str, object],
    steps: int | None = None,
    networks: Sequence[str] | None = None,
    seeds: int = 3,
) -> list[Run]:
    """Return the runs: the sets of `FIRST` with one seed, their other seeds, the other sets.

    The recipe is common to all runs; without steps they are the recipe's, without networks all of
    the paper's table. Those of `LEADING` have so many seeds, the others one.

    Raises:
        InputError: a network is unknown.
        ConfigError: a setting of the recipe is unknown or out of range.
    """
    names = list(networks or [*LEADING, *(n for n in ARCHITECTURES if n not in LEADING)])
    for name in names:
        architecture(name)

    first = [dataset for dataset in sets if dataset.name in FIRST]
    others = [dataset for dataset in sets if dataset.name not in FIRST]
    leading = [name for name in names if name in LEADING]
    runs = []
    for part in (first, others):
        for seed, dataset in product(range(seeds), part):
            if seed == 0:
                # Unlike the default weights, these know none of the groups that `ALL` holds out.
                weights = "first-stage" if dataset.name == ALL else "default"
                runs += [Run(dataset, name, 0, None) for name in (PDR, weights)]
            for name in leading if seed else names:
                runs.append(Run(dataset, name, seed, run_recipe(recipe, name, seed, steps)))
    return runs


def run_recipe(
    values: dict[str, object], network: str, seed: int, steps: int | None
) -> TrainingConfig:
    """Return the recipe of a run: the common values with a network, a seed and a number of steps.

    It is approximate, since epochs have equal lengths; None for the common recipe's.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """
    recipe = training_config({**values, "architecture": network, "seed": seed})
    steps = recipe.steps if steps is None else steps
    epochs = max(1, math.ceil(steps / _EPOCH_STEPS))
    per_epoch = max(1, round(steps / epochs))
    lengths = {"epochs": epochs, "epoch_windows": per_epoch * recipe.batch, "patience": epochs}
    return training_config({**values, "architecture": network, "seed": seed, **lengths})


@contextmanager
def backend(name: str) -> Iterator[None]:
    """Select joblib's backend within a block: "loky" (processes on this machine), "dask" or "ray".

    Dask uses the scheduler named in its configuration (`DASK_SCHEDULER_ADDRESS`), Ray the cluster
    at `RAY_ADDRESS`; without these, both start on this machine.

    Raises:
        InputError: the name is unknown, or the backend's package is not installed.
    """
    from joblib import parallel_config

    check_choice("--backend", name, ("loky", "dask", "ray"))
    with ExitStack() as within:
        if name == "dask":
            distributed = optional_package("distributed", "cluster")
            logging.getLogger("distributed").setLevel(logging.WARNING)
            within.enter_context(distributed.Client())
        elif name == "ray":
            try:
                importlib.import_module("ray.util.joblib").register_ray()
            except ImportError as error:
                found, fix = "ray, not installed", "pip install ray"
                raise InputError("--backend", found, "ray", fix) from error
        within.enter_context(parallel_config(name))
        yield
