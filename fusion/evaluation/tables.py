"""Networks side by side over many recordings: the paper's table.

Each network yields three tracks of each recording: chained displacements with the true attitude
(the papers' protocol), the same with the attitude levelled from the IMU, and the EKF's. Several
weights of one network, for example from different training seeds, are averaged, with their spread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.many import distinct_name
from stario.fusion.evaluation.tracks import network_track, network_track_true_attitude, true_poses
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.recording import Progress, silent
from stario.network.model import DisplacementModel
from stario.network.runtime.cost import table_cost
from stario.sequences.accuracy.metrics import CONVENTIONS, Convention, align, evaluate_track
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.truth.problems import warn_of_truth

TRUE_ATTITUDE, OWN_ATTITUDE, EKF = "network_true_attitude", "network", "ekf"

PROTOCOLS = {
    TRUE_ATTITUDE: "network, true attitude",
    OWN_ATTITUDE: "network, own attitude",
    EKF: "EKF",
}
"""Tracks of the table and their titles."""

METRICS = {"ate_m": "ATE [m]", "rte_m": "RTE [m]", "pde": "PDE [1]"}

MAX_DRAWN = 4
"""Number of recordings whose tracks are kept for a figure."""


@dataclass(frozen=True)
class Entry:
    """Errors of one track; see `stario.sequences.accuracy.metrics.CONVENTIONS`.

    Attributes:
        recording: name of the recording.
        network: architecture.
        weights: weights file, or "default".
        protocol: one of `PROTOCOLS`.
        ate_m: absolute trajectory error [m].
        rte_m: relative trajectory error [m].
        pde: position drift error [1].
    """

    recording: str
    network: str
    weights: str
    protocol: str
    ate_m: float
    rte_m: float
    pde: float


@dataclass(frozen=True, eq=False)
class Sample:
    """Tracks of one recording with the true attitude, aligned with the truth, for a figure.

    Attributes:
        recording: name of the recording.
        truth: true track.
        tracks: tracks by network.
        errors: ATE and RTE [m] of each track.
    """

    recording: str
    truth: Trajectory
    tracks: dict[str, Trajectory]
    errors: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class NetworkTable:
    """Errors of several networks on several recordings.

    Attributes:
        convention: how position errors are averaged.
        parameters: parameter count by network, in the table's order, by the paper's convention.
        entries: errors of all tracks.
        samples: tracks of some recordings.
    """

    convention: Convention
    parameters: dict[str, int]
    entries: list[Entry] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)

    def values(self, network: str, protocol: str, metric: str) -> FloatArray:
        """Return a metric (N,) of a network's tracks, of all weights and recordings."""
        return np.array([getattr(entry, metric) for entry in self._entries(network, protocol)])

    def mean_and_spread(
        self, network: str, protocol: str, metric: str, recording: str = ""
    ) -> tuple[float, float | None]:
        """Return the mean over recordings, or of one, and its standard deviation over weights.

        NaN if no recording has a value: at rest, there is no share of the path.
        """
        chosen = [e for e in self._entries(network, protocol) if recording in ("", e.recording)]
        by_weights = [
            _mean([getattr(e, metric) for e in chosen if e.weights == weights])
            for weights in dict.fromkeys(e.weights for e in chosen)
        ]
        spread = float(np.std(by_weights, ddof=1)) if len(by_weights) > 1 else None
        return float(np.mean(by_weights)), spread

    def _entries(self, network: str, protocol: str) -> list[Entry]:
        return [e for e in self.entries if (e.network, e.protocol) == (network, protocol)]


Models = Sequence[tuple[str, DisplacementModel]]
"""Models, each with the name by which its weights were requested."""


def compare_networks(
    paths: Sequence[Path],
    models: Models,
    config: NavigatorConfig,
    read: Callable[[Path], ImuSequence],
    convention: Convention = "rms",
    jobs: int | None = None,
    progress: Progress = silent,
) -> tuple[NetworkTable, list[Skipped]]:
    """Compute the tracks of networks, given with distinct names, on recordings with true poses.

    Recordings that cannot be used are returned, too. `read` must be picklable; `jobs` is as for
    `stario.sequences.datasets.batch.each`.
    """
    parameters = {model.name: table_cost(model.name).parameters for _, model in models}
    table, skipped = NetworkTable(convention, parameters), []
    names: set[str] = set()
    work = partial(_tracks, models=models, config=config, read=read, convention=convention)
    for done, outcome in enumerate(each(work, paths, jobs), 1):
        if isinstance(outcome, Skipped):
            skipped.append(outcome)
        else:
            entries, sample = outcome
            name = distinct_name(sample.recording, names)
            table.entries.extend(replace(entry, recording=name) for entry in entries)
            if len(table.samples) < MAX_DRAWN:
                table.samples.append(replace(sample, recording=name))
        progress(done / len(paths))
    return table, skipped


def table_text(table: NetworkTable) -> str:
    """Return the table as text: a block per protocol and metric, recordings by networks."""
    networks = list(table.parameters)
    recordings = list(dict.fromkeys(e.recording for e in table.entries))
    lines = []
    for protocol, words in PROTOCOLS.items():
        for metric, title in METRICS.items():
            lines.append(f"{words}: {title}")
            rows = [["", *networks]]
            for recording in [*recordings, ""]:
                cells = [table.mean_and_spread(n, protocol, metric, recording) for n in networks]
                rows.append([recording or "mean", *(_cell(*cell) for cell in cells)])
            lines += [*aligned(rows), ""]
    return "\n".join([*lines, *(f"{name}: {text}." for name, text in _words(table).items())])


def table_dict(table: NetworkTable) -> dict[str, object]:
    """Return the table as plain values."""
    means: dict[str, dict[str, dict[str, object]]] = {}
    for network, protocol, metric in product(table.parameters, PROTOCOLS, METRICS):
        mean, spread = table.mean_and_spread(network, protocol, metric)
        metrics = means.setdefault(network, {}).setdefault(protocol, {})
        metrics[metric] = {"mean": mean, "spread": spread}
    return {
        "networks": table.parameters,
        "over_recordings": means,
        "entries": [asdict(entry) for entry in table.entries],
        "conventions": _words(table),
    }


def _words(table: NetworkTable) -> dict[str, str]:
    keys = ("ate_m", "rte_m", "pde", "alignment", "convention")
    return {
        **{key: CONVENTIONS[key] for key in keys},
        "here": f"horizontal errors, alignment first, convention {table.convention}",
        "mean": "over recordings, equally weighted; +- deviation over weights of one network",
    }


def _cell(mean: float, spread: float | None) -> str:
    return figure(mean) if spread is None else f"{figure(mean)}+-{figure(spread)}"


def _mean(values: Sequence[float]) -> float:
    """Return the mean of the values that are known; NaN if none is."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def _tracks(
    path: Path,
    models: Models,
    config: NavigatorConfig,
    read: Callable[[Path], ImuSequence],
    convention: Convention,
) -> tuple[list[Entry], Sample]:
    sequence = read(path)
    truth = true_poses(sequence)
    warn_of_truth(sequence)
    entries: list[Entry] = []
    sample = Sample(sequence.name, truth, {}, {})
    for weights, model in models:
        for protocol, track in protocol_tracks(model, sequence, config).items():
            errors = metrics_of(track, truth, convention)
            entries.append(Entry(sequence.name, model.name, weights, protocol, **errors))
            if protocol == TRUE_ATTITUDE and model.name not in sample.tracks:
                sample.tracks[model.name] = align(track, truth, "first")
                sample.errors[model.name] = errors["ate_m"], errors["rte_m"]
    return entries, sample


def metrics_of(track: Trajectory, truth: Trajectory, convention: Convention) -> dict[str, float]:
    """Return the `METRICS` of a track."""
    result = evaluate_track(track, truth, convention=convention)
    return {name: getattr(result, name) for name in METRICS}


def protocol_tracks(
    model: Predictor, sequence: ImuSequence, config: NavigatorConfig
) -> dict[str, Trajectory]:
    """Return the tracks of `PROTOCOLS`; raises the errors of `network_track_true_attitude`."""
    navigator = Navigator(model, config)
    preprocessed = navigator.observe(sequence)
    true_attitude = network_track_true_attitude(model, sequence, config)
    return {
        TRUE_ATTITUDE: true_attitude.trajectory,
        OWN_ATTITUDE: network_track(preprocessed).trajectory,
        EKF: navigator.track(preprocessed).trajectory,
    }
