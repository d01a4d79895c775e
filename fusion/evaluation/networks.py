"""Networks side by side over many recordings: the paper's table.

Each network yields three tracks of each recording: chained displacements with the true attitude
(the papers' protocol), the same with the attitude levelled from the IMU, and the filter's. Several
weights of one network, for example from different training seeds, are averaged, with their spread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import pandas as pd

from stario.fusion.evaluation.compare import TRACK_TITLES, distinct_name
from stario.fusion.evaluation.scores import Spread, joined, records, scored, table
from stario.fusion.evaluation.tracks import network_track, network_track_true_attitude, true_poses
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.values.config import NavigatorConfig
from stario.network.model import DisplacementModel
from stario.network.runtime.survey import table_counts
from stario.sequences.accuracy.metrics import (
    CONVENTIONS,
    Convention,
    PoseErrors,
    align,
    evaluate_track,
    pose_errors,
)
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.truth.problems import warn_of_truth

TRUE_ATTITUDE, OWN_ATTITUDE, FILTERED = "network_true_attitude", "network", "filtered"

PROTOCOLS = {name: TRACK_TITLES[name] for name in (TRUE_ATTITUDE, OWN_ATTITUDE, FILTERED)}
"""Tracks of the table and their titles."""

METRICS = {"ate_m": "ATE [m]", "rte_m": "RTE [m]", "pde": "PDE [1]"}

MAX_DRAWN = 4
"""Number of recordings whose tracks are kept for a figure."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Tracks of one recording with the true attitude, aligned with the truth, for a figure.

    Attributes:
        recording: name of the recording.
        truth: true track.
        tracks: horizontal track (N, 2) [m] of each network.
    """

    recording: str
    truth: Trajectory
    tracks: dict[str, FloatArray]


@dataclass(frozen=True, eq=False)
class NetworkTable:
    """Errors of several networks on several recordings.

    Attributes:
        convention: how position errors are averaged.
        parameters: parameter count by network, in the table's order.
        scores: `METRICS` of the tracks of `PROTOCOLS`, with labels `network` and `weights`.
        samples: tracks of some recordings.
    """

    convention: Convention
    parameters: dict[str, int]
    scores: pd.DataFrame
    samples: list[Sample]

    def column(self, network: str, protocol: str, metric: str) -> Spread:
        """Return a network's column: means over recordings, their deviation over weights."""
        where = {"network": network, "track": protocol}
        return Spread(network, metric, ".3f", where=where, by="weights")

    @property
    def entries(self) -> list[dict[str, object]]:
        """Errors of every track as plain values."""
        return records(self.scores.drop(columns="group").rename(columns={"track": "protocol"}))

    @property
    def words(self) -> dict[str, str]:
        """Meaning of the table's words."""
        keys = ("ate_m", "rte_m", "pde", "alignment", "convention")
        return {
            **{key: CONVENTIONS[key] for key in keys},
            "here": f"horizontal errors, alignment first, convention {self.convention}",
            "mean": "over recordings, equally weighted; +- deviation over weights of one network",
        }

    def as_dict(self) -> dict[str, object]:
        """Return the table as plain values."""
        means: dict[str, dict[str, dict[str, object]]] = {}
        for network, protocol, metric in product(self.parameters, PROTOCOLS, METRICS):
            mean, spread = self.column(network, protocol, metric).mean_and_spread(self.scores)
            metrics = means.setdefault(network, {}).setdefault(protocol, {})
            metrics[metric] = {"mean": mean, "spread": spread}
        return {
            "networks": self.parameters,
            "over_recordings": means,
            "entries": self.entries,
            "conventions": self.words,
        }

    def text(self) -> str:
        """Return a block for each protocol and metric, recordings by networks."""
        rows = [*self.scores.groupby("recording", sort=False), ("mean", self.scores)]
        lines = []
        for protocol, words in PROTOCOLS.items():
            for metric, title in METRICS.items():
                columns = [self.column(name, protocol, metric) for name in self.parameters]
                lines += [f"{words}: {title}", table(rows, columns, ("",)), ""]
        return "\n".join([*lines, *(f"{key}: {words}." for key, words in self.words.items())])


Models = Sequence[tuple[str, DisplacementModel]]
"""Models, each with the name by which its weights were requested."""


def networks_on(
    path: Path,
    models: Models,
    config: NavigatorConfig,
    read: Callable[[Path], ImuSequence],
    convention: Convention = "rms",
) -> tuple[pd.DataFrame, Sample]:
    """Score networks, given with distinct names, on a recording with true poses.

    Returns the rows of `NetworkTable.scores`, and the tracks.
    """
    sequence = read(path)
    scores: list[pd.DataFrame] = []
    tracks: dict[str, FloatArray] = {}
    for weights, model in models:
        figures, errors = protocol_figures(model, sequence, config, convention)
        scores.append(scored(sequence.name, figures, network=model.name, weights=weights))
        tracks.setdefault(model.name, errors.estimate.position_W[:, :2])
    warn_of_truth(sequence)
    return joined(scores), Sample(sequence.name, errors.truth, tracks)


def network_table(
    found: Iterable[tuple[pd.DataFrame, Sample]], models: Models, convention: Convention
) -> NetworkTable:
    """Return the table of the recordings that `networks_on` scored, under distinct names."""
    names: set[str] = set()
    scores, samples = [], []
    for rows, sample in found:
        name = distinct_name(sample.recording, names)
        scores.append(rows.assign(recording=name))
        samples.append(replace(sample, recording=name))
    parameters = {model.name: table_counts(model.name)[0] for _, model in models}
    return NetworkTable(convention, parameters, joined(scores), samples[:MAX_DRAWN])


def protocol_figures(
    model: Predictor, sequence: ImuSequence, config: NavigatorConfig, convention: Convention
) -> tuple[dict[str, dict[str, float]], PoseErrors]:
    """Return the `METRICS` of the tracks of `PROTOCOLS`, and the errors with the true attitude.

    These are those of a track aligned by its first pose. Raises the errors of
    `network_track_true_attitude`.
    """
    truth = true_poses(sequence)
    navigator = Navigator(model, config, backend="ekf")
    preprocessed = navigator.observe(sequence)
    tracks = {
        TRUE_ATTITUDE: network_track_true_attitude(model, sequence, config).trajectory,
        OWN_ATTITUDE: network_track(preprocessed).trajectory,
        FILTERED: navigator.track(preprocessed).trajectory,
    }
    figures = {name: metrics_of(track, truth, convention) for name, track in tracks.items()}
    return figures, pose_errors(align(tracks[TRUE_ATTITUDE], truth, "first"), truth)


def metrics_of(track: Trajectory, truth: Trajectory, convention: Convention) -> dict[str, float]:
    """Return the `METRICS` of a track."""
    result = evaluate_track(track, truth, convention=convention)
    return {name: getattr(result, name) for name in METRICS}
