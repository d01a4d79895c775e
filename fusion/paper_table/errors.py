"""Errors of a network on its test recordings, for every kind of ground truth.

With poses: the paper's protocol, own attitude and filtered. With any truth: the network alone along
its own attitude, by `stario.fusion.evaluation.benchmark.displacement_error`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from stario.fusion.config import NavigatorConfig
from stario.fusion.evaluation.benchmark.displacement_error import (
    block_sums,
    known_truth,
    recording_errors,
)
from stario.fusion.evaluation.benchmark.pieces import usable_streams
from stario.fusion.evaluation.networks import MAX_DRAWN, OWN_ATTITUDE, metrics_of, protocol_figures
from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning, pedestrian_track, piece_of
from stario.fusion.evaluation.tracks import true_poses
from stario.fusion.paper_table.training import ReaderConfig
from stario.network.model import DisplacementModel
from stario.sequences.accuracy.metrics import Convention
from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.datasets.splits import ListEntry
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.truth.problems import warn_of_truth

CONVENTION: Convention = "ronin"
"""How errors are averaged: as in the paper."""


Model = DisplacementModel | PedestrianDeadReckoning


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
    alone = recording_errors(sequence, [piece_of(model, stream) for stream in streams])
    blocks = {"10": alone.blocks["10"].tolist()} if "10" in alone.blocks else {}
    row: dict[str, object] = {
        "path": str(path),
        "group": groups[path],
        "recording": sequence.name,
        "kind": kind,
        "path_m": alone.path_m,
        "figures": alone.figures,
        "blocks": blocks,
        "tracks": {},
    }
    if kind != "poses":
        return row, {}
    if isinstance(model, PedestrianDeadReckoning):
        track = pedestrian_track(sequence).trajectory
        row["tracks"] = {OWN_ATTITUDE: metrics_of(track, true_poses(sequence), CONVENTION)}
        return row, {}
    row["tracks"], errors = protocol_figures(model, sequence, NavigatorConfig(), CONVENTION)
    time, squares = errors.estimate.time, (errors.position_W[:, :2] ** 2).sum(axis=1)
    blocks["ate"] = block_sums(time - time[0], squares).tolist()
    xy = {"track": errors.estimate.position_W[:, :2], "truth": errors.truth.position_W[:, :2]}
    return row, {"time": time, **xy}
