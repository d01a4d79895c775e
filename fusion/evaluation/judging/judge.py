"""Evaluation of networks alone by groups of recordings: sets, people, devices, places.

Each recording is prepared once and run through every network. `displacement_error` defines the
errors, `bootstrap` the confidence intervals.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from stario.fusion.evaluation.judging.bootstrap import Blocks, Interval, paired_ratio
from stario.fusion.evaluation.judging.displacement_error import (
    FIGURES,
    HORIZONS,
    RecordingErrors,
    recording_errors,
)
from stario.fusion.evaluation.judging.network_alone import RecordingPredictor, predictions
from stario.fusion.evaluation.judging.prepared import Prepared
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.sequences.datasets.batch import Skipped, without_skipped
from stario.sequences.readers.archive import split_name
from stario.sequences.sequence import ImuSequence

log = logging.getLogger(__name__)

By = Literal["set", "group", "person", "device", "place", "carry"]

POOLED = "all"
"""Name of the row over all sets, equally weighted; a group may have this name, too."""

_UNKNOWN = "unknown"
"""Label of a recording whose person, device, place or carry is not known."""

_NOT_COMPARED = (
    "not compared, because the ground truth moves by less than a metre, or has neither 2 s of "
    "known positions nor three waypoints within an unbroken stretch of samples"
)


@dataclass(frozen=True, eq=False)
class RecordingResult:
    """Errors of one recording for every set of weights.

    Attributes:
        path: path of the recording.
        labels: its set, group, person, device, place and carry.
        errors: errors by name of the weights.
    """

    path: Path
    labels: dict[str, str]
    errors: dict[str, RecordingErrors]


@dataclass(frozen=True, eq=False)
class Row:
    """A group of recordings.

    Attributes:
        name: name of the group, or `POOLED`.
        recordings: number of recordings compared; those with fewer than three waypoints are not.
        path_km: total length of their true paths.
        medians: medians over recordings, by name of the weights and by figure.
        ratios: ratios of errors over 1, 10 and 30 s to those of the weights compared with, by
            figure; empty without these. For waypoints, the residuals replace the 10 s errors.
        pooled: whether the row covers all groups.
    """

    name: str
    recordings: int
    path_km: float
    medians: dict[str, dict[str, float]]
    ratios: dict[str, Interval]
    pooled: bool = False


def judge(
    recordings: Iterable[Prepared | Skipped],
    models: Mapping[str, Callable[[str], Predictor | RecordingPredictor]],
    groups: Mapping[Path, str],
    read: Callable[[Path], ImuSequence] | None = None,
) -> tuple[list[RecordingResult], list[Skipped]]:
    """Run every recording through every network.

    Args:
        recordings: prepared recordings, and those skipped.
        models: by name of the weights, a function that returns the network for a group: networks
            differ between groups if each group was held out of training in turn.
        groups: group of each recording, by path; the name of the set where missing.
        read: function that reads a path; if given, the EKF is run for its mean NIS, which is slow.
    """
    judged: list[RecordingResult] = []
    skipped: list[Skipped] = []
    for prepared in without_skipped(recordings, skipped):
        named = labels(prepared.path, prepared.attributes, groups.get(prepared.path, ""))
        errors = {
            name: _errors(model(named["group"]), prepared, read) for name, model in models.items()
        }
        judged.append(RecordingResult(prepared.path, named, errors))
    _warn_of_not_compared(judged)
    return judged, skipped


def _warn_of_not_compared(judged: Sequence[RecordingResult]) -> None:
    """Log one warning about all recordings in which nothing could be compared."""
    paths = [r.path for r in judged if not any(e.path_m > 0.0 for e in r.errors.values())]
    if len(paths) > 1:
        message = "%d of %d recordings, the first %s: %s"
        log.warning(message, len(paths), len(judged), paths[0], _NOT_COMPARED)
    elif paths:
        log.warning("%s: %s", paths[0], _NOT_COMPARED)


def _errors(
    model: Predictor | RecordingPredictor,
    prepared: Prepared,
    read: Callable[[Path], ImuSequence] | None,
) -> RecordingErrors:
    found = recording_errors(prepared, predictions(model, prepared))
    if read is None or isinstance(model, RecordingPredictor):
        return found
    nis = Navigator(model).run(read(prepared.path)).nis
    assert nis is not None  # the EKF reports its health
    return replace(found, figures=found.figures | {"nis_ekf": nis})


def rows_of(judged: Sequence[RecordingResult], by: By, ours: str, theirs: str | None) -> list[Row]:
    """Return a row for each group, sorted by name, and one over all if there are several.

    `ours` and `theirs` name the weights under evaluation and those to compare them with, if any.
    """
    names = sorted({result.labels[by] for result in judged})
    parts = [(name, [result for result in judged if result.labels[by] == name]) for name in names]
    rows = [_row(name, part, ours, theirs) for name, part in parts]
    if len(rows) > 1:
        rows.append(replace(_row(POOLED, judged, ours, theirs), pooled=True))
    return rows


def _row(name: str, part: Sequence[RecordingResult], ours: str, theirs: str | None) -> Row:
    weights = [ours] if theirs is None else [ours, theirs]
    medians = {
        weights_name: {
            figure: _median([result.errors[weights_name].figures[figure] for result in part])
            for figure in FIGURES
        }
        for weights_name in weights
    }
    ratios = {}
    if theirs is not None:
        found = {h: paired_ratio(_strata(part, str(h), ours, theirs)) for h in HORIZONS}
        ratios = {f"rms_{h}s_m": ratio for h, ratio in found.items() if ratio is not None}
    paths = [result.errors[ours].path_m for result in part]
    return Row(name, sum(path > 0.0 for path in paths), sum(paths) / 1e3, medians, ratios)


def _strata(
    part: Sequence[RecordingResult], measure: str, ours: str, theirs: str
) -> dict[str, dict[str, list[Blocks]]]:
    strata: dict[str, dict[str, list[Blocks]]] = {}
    for result in part:
        pair = [result.errors[name].blocks.get(measure) for name in (ours, theirs)]
        blocks = tuple(each[:, 0] for each in pair if each is not None and len(each))
        if len(blocks) == 2 and all(each.sum() > 0.0 for each in blocks):
            groups = strata.setdefault(result.labels["set"], {})
            groups.setdefault(result.labels["group"], []).append((blocks[0], blocks[1]))
    return strata


def labels(path: Path, attributes: Mapping[str, object], group: str = "") -> dict[str, str]:
    """Return the labels that a recording can be grouped by, given its group in a list, if any.

    Its set is the first word of its group, or else the name of its archive or folder. OxIOD names
    folders by the form of their data: `syn` counts as `oxiod`. Without a list, a group is all of
    one person in a set, where the person is known: intervals tell how persons differ.
    """
    file, member = split_name(path)
    above = file.absolute().parent.name
    folder = "oxiod" if above == "syn" else above
    set_name = group.split(" ")[0] if group else file.stem if member else folder
    known = {key: str(attributes.get(key) or _UNKNOWN) for key in get_args(By)[2:]}
    of_person = set_name if known["person"] == _UNKNOWN else f"{set_name} {known['person']}"
    return {"set": set_name, "group": group or of_person, **known}


def _median(values: Sequence[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else float("nan")
