"""Runs of the table: a network trained and tested on a data set with a seed, kept as files.

`<out>/<set>/<network>/<n>-steps/seed-<n>/` holds the model and `trained.json` once training is
done, then `errors.json`. Repeating a run adds only what is missing.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from time import process_time

import pandas as pd

from stario.fusion.evaluation.compare import TRACK_TITLES
from stario.fusion.evaluation.displacement_error import (
    BLOCK_SECONDS,
    known_truth,
    recording_errors,
    usable_streams,
)
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.evaluation.pedestrian import (
    Model,
    PedestrianDeadReckoning,
    model_named,
    pedestrian_track,
    piece_of,
)
from stario.fusion.evaluation.tracks import network_track, network_track_true_attitude, true_poses
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.paper_table.sets import ALL, FIRST, DataSet
from stario.fusion.paper_table.training import (
    TEMPORARY_FILES,
    ReaderConfig,
    recipe_digest,
    recording_state,
    run_recipe,
    train_run,
)
from stario.network.architectures import ARCHITECTURES, architecture
from stario.network.model import load_model
from stario.network.training.config import TrainingConfig
from stario.sequences.accuracy.metrics import PoseErrors, align, evaluate_track, pose_errors
from stario.sequences.arrays import check_choice
from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.datasets.splits import ListEntry
from stario.sequences.errors import ConfigError, InputError, ReadError
from stario.sequences.files import write_json
from stario.sequences.lazy import optional_package
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.truth.problems import warn_of_truth

LEADING = ("StarIO", "R-ResNet", "DeepILS", "StarIO without MSGCU")
"""Networks that are completed first, and with several seeds."""

TRUE_ATTITUDE, OWN_ATTITUDE, FILTERED = "network_true_attitude", "network", "filtered"

PROTOCOLS = {name: TRACK_TITLES[name] for name in (TRUE_ATTITUDE, OWN_ATTITUDE, FILTERED)}
"""Tracks of a network and their titles; the first is that of the papers' protocol."""

MAX_DRAWN = 4
"""Number of recordings whose tracks are kept for a figure."""


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
        if self.recipe is None:
            learned = "" if self.network == PDR else _weights_sha256(self.network)
        else:
            learned = recipe_digest(self.recipe, self.dataset)
        return hashlib.sha256(json.dumps([self.network, learned, test]).encode()).hexdigest()


@cache
def _weights_sha256(name: str) -> str:
    return load_model(name).card.sha256


def reference_rows(dataset: DataSet) -> tuple[str, ...]:
    """Return the references that are compared with the networks trained on a set.

    The default weights were trained on the groups that `ALL` holds out; the first-stage weights,
    of the same architecture, were not.
    """
    return (PDR, "first-stage") if dataset.name == ALL else (PDR, "default")


def complete_run(run: Run, out: Path, reading: ReaderConfig) -> Run:
    """Train and evaluate a run, except for what is already done.

    Raises:
        ConfigError: existing results were made with another recipe, other weights or other
            recordings.
        InputError: the network cannot be trained.
    """
    folder = run.folder(out)
    if _read_if_done(run, folder / "errors.json") is not None:
        return run
    folder.mkdir(parents=True, exist_ok=True)
    if run.recipe is not None and _read_if_done(run, folder / "trained.json") is None:
        trained = train_run(run.dataset, run.recipe, folder, reading)
        write_json(folder / "trained.json", {"cell": run.digest, **trained})
        for spare in TEMPORARY_FILES:
            (folder / spare).unlink(missing_ok=True)
    began = process_time()
    found, skipped = test_errors(_model(run, folder), run.dataset.test, reading)
    content = {
        "cell": run.digest,
        "network": run.network,
        "seed": run.seed,
        "seconds": process_time() - began,
        "recordings": found,
        "skipped": [asdict(failure) for failure in skipped],
    }
    write_json(folder / "errors.json", content)
    return run


def read_run(run: Run, out: Path) -> dict[str, object] | None:
    """Return the content of a run's `errors.json` and `trained.json`; None if it is not completed.

    Raises:
        ConfigError: it was completed with another recipe, other weights or other recordings.
    """
    folder = run.folder(out)
    content = _read_if_done(run, folder / "errors.json")
    if content is None or run.recipe is None:
        return content
    return content | {"trained": _read(folder / "trained.json")}


def test_errors(
    model: Model, test: Sequence[ListEntry], reading: ReaderConfig
) -> tuple[list[dict[str, object]], list[Skipped]]:
    """Return the errors on every recording, and the recordings that were skipped.

    Returns:
        Plain values for each recording: `recording`, `path`, `group`, `kind` of truth, `path_m`;
        `tracks` with ATE, RTE and PDE by track; `figures` as in `displacement_error.FIGURES`;
        `blocks` of 30 s, [sum of squares, count], of the position error under the paper's protocol
        ("ate") and of the displacement error over 10 s ("10"); for the first recordings with poses
        `drawn`, the track with the true attitude: time (N,) [s], horizontal positions `track` and
        `truth` (N, 2) [m].
    """
    found: list[dict[str, object]] = []
    left_out: list[Skipped] = []
    drawn = 0
    groups = {entry.path: entry.group for entry in test}
    outcomes = each(partial(_recording, model=model, read=reading.read, groups=groups), groups, 1)
    for row, track in without_skipped(outcomes, left_out):
        if track and drawn < MAX_DRAWN:
            row["drawn"], drawn = track, drawn + 1
        found.append(row)
    return found, left_out


def _recording(
    path: Path, model: Model, read: Callable[[Path], ImuSequence], groups: Mapping[Path, str]
) -> tuple[dict[str, object], dict[str, FloatArray]]:
    sequence = read(path)
    streams, (kind, _) = usable_streams(sequence), known_truth(sequence)
    warn_of_truth(sequence)
    figures, errors = recording_errors(sequence, [piece_of(model, stream) for stream in streams])
    within_10s = errors[errors["metric"] == "rms_10s_m"]
    blocks = {} if within_10s.empty else {"10": within_10s[["squares", "count"]].values.tolist()}
    row: dict[str, object] = {
        "path": str(path),
        "group": groups[path],
        "recording": sequence.name,
        "kind": kind,
        "path_m": figures.pop("path_m"),
        "figures": figures,
        "blocks": blocks,
        "tracks": {},
    }
    if kind != "poses":
        return row, {}
    if isinstance(model, PedestrianDeadReckoning):
        track = pedestrian_track(sequence).trajectory
        row["tracks"] = {OWN_ATTITUDE: _errors_of(track, true_poses(sequence))}
        return row, {}
    row["tracks"], poses = _protocol_errors(model, sequence)
    time, squares = poses.estimate.time, (poses.position_W[:, :2] ** 2).sum(axis=1)
    by_block = pd.Series(squares).groupby((time - time[0]) // BLOCK_SECONDS)
    blocks["ate"] = by_block.agg(["sum", "count"]).values.tolist()
    xy = {"track": poses.estimate.position_W[:, :2], "truth": poses.truth.position_W[:, :2]}
    return row, {"time": time, **xy}


def _protocol_errors(
    model: Predictor, sequence: ImuSequence
) -> tuple[dict[str, dict[str, float]], PoseErrors]:
    """Return the errors of the tracks of `PROTOCOLS`, and those of the poses of the first."""
    truth = true_poses(sequence)
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


def _model(run: Run, folder: Path) -> Model:
    if run.network in ARCHITECTURES:
        return load_model(folder / "model.safetensors")
    return model_named(run.network)


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
                runs += [Run(dataset, name, 0, None) for name in reference_rows(dataset)]
            for name in leading if seed else names:
                runs.append(Run(dataset, name, seed, run_recipe(recipe, name, seed, steps)))
    return runs


def complete(
    runs: Sequence[Run], out: Path, reading: ReaderConfig, jobs: int | None = 1
) -> Iterator[Run | Skipped]:
    """Do what is missing; yield each run once it is completed, or the reason why it is not.

    Runs are started in their order; `out` must be writable by every process that takes part.
    `jobs` is as for `stario.sequences.datasets.batch.each`.
    """
    return each(partial(complete_run, out=out, reading=reading), runs, jobs)


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
