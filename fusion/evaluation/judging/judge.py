"""Networks alone judged by groups of recordings: sets, people, devices, places.

Each recording is prepared once and shown to every network. `displacement_error`
says what is measured, `bootstrap` how sure it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from stario.fusion.evaluation.judging.bootstrap import Blocks, Interval, paired_ratio
from stario.fusion.evaluation.judging.displacement_error import (
    FIGURES,
    HORIZONS,
    RecordingErrors,
    recording_errors,
)
from stario.fusion.evaluation.judging.network_alone import Answering, answers
from stario.fusion.evaluation.judging.prepared import Prepared
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.sequences.datasets.batch import Skipped
from stario.sequences.errors import InputError
from stario.sequences.readers.archive import split_name
from stario.sequences.sequence import ImuSequence

By = Literal["set", "group", "person", "device", "place", "carry"]

POOLED = "all"
"""Name of the row over all sets, each counting alike; a group may be called so, too."""


@dataclass(frozen=True, eq=False)
class Judged:
    """One recording under every set of weights.

    Attributes:
        path: of the recording.
        labels: set, group, person, device, place, carry.
        errors: by the name of the weights.
    """

    path: Path
    labels: dict[str, str]
    errors: dict[str, RecordingErrors]


@dataclass(frozen=True, eq=False)
class Row:
    """A group of recordings.

    Attributes:
        name: of the group, or `POOLED`.
        recordings: how many could be compared: fewer than three waypoints tell nothing.
        path_km: their true paths together.
        medians: over recordings by the name of the weights and by figure.
        ratios: of errors over 1, 10 and 30 s, ours over theirs, by figure; without weights to
            compare with empty. Of waypoints the residuals stand in for 10 s.
        pooled: whether it is over all groups.
    """

    name: str
    recordings: int
    path_km: float
    medians: dict[str, dict[str, float]]
    ratios: dict[str, Interval]
    pooled: bool = False


def check_by(name: str) -> By:
    """A word as what to group by.

    Raises:
        InputError: there is no such grouping.
    """
    if name in get_args(By):
        return cast(By, name)
    raise InputError("--by", repr(name), f"one of {', '.join(get_args(By))}")


def judge(
    recordings: Iterable[Prepared | Skipped],
    models: Mapping[str, Callable[[str], Predictor | Answering]],
    groups: Mapping[Path, str],
    read: Callable[[Path], ImuSequence] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[list[Judged], list[Skipped]]:
    """Show every recording to every network.

    Args:
        recordings: prepared, or why not.
        models: by the name of the weights, the network for a group: another for each group where
            each was left out of training in turn.
        groups: of each recording's path; the set's name where none is known.
        read: how a path is read, for the EKF, whose mean NIS is then told as well; slow.
        progress: called with the number of recordings done.
    """
    judged: list[Judged] = []
    skipped: list[Skipped] = []
    for done, prepared in enumerate(recordings, 1):
        if isinstance(prepared, Skipped):
            skipped.append(prepared)
        else:
            named = labels(prepared.path, prepared.attributes, groups.get(prepared.path, ""))
            errors = {
                name: _errors(model(named["group"]), prepared, read)
                for name, model in models.items()
            }
            judged.append(Judged(prepared.path, named, errors))
        progress(done)
    return judged, skipped


def _errors(
    model: Predictor | Answering,
    prepared: Prepared,
    read: Callable[[Path], ImuSequence] | None,
) -> RecordingErrors:
    found = recording_errors(prepared, answers(model, prepared))
    if read is None or isinstance(model, Answering):
        return found
    health = Navigator(model).run(read(prepared.path)).health
    nis = float("nan") if health is None else health.mean_nis
    return replace(found, figures=found.figures | {"nis_ekf": nis})


def rows_of(judged: Sequence[Judged], by: By, ours: str, theirs: str | None) -> list[Row]:
    """A row for each group, sorted, and one over all.

    Args:
        judged: the recordings.
        by: what they are grouped by.
        ours: weights that are judged.
        theirs: weights that they are compared with, if any.
    """
    names = sorted({one.labels[by] for one in judged})
    parts = [(name, [one for one in judged if one.labels[by] == name]) for name in names]
    rows = [_row(name, part, ours, theirs) for name, part in parts]
    if len(rows) > 1:
        rows.append(replace(_row(POOLED, judged, ours, theirs), pooled=True))
    return rows


def _row(name: str, part: Sequence[Judged], ours: str, theirs: str | None) -> Row:
    weights = [ours] if theirs is None else [ours, theirs]
    medians = {
        one: {figure: _median([j.errors[one].figures[figure] for j in part]) for figure in FIGURES}
        for one in weights
    }
    ratios = {}
    for horizon in HORIZONS if theirs is not None else ():
        assert theirs is not None
        found = paired_ratio(_strata(part, str(horizon), ours, theirs))
        if found is not None:
            ratios[f"rms_{horizon}s_m"] = found
    paths = [j.errors[ours].path_m for j in part]
    return Row(name, sum(path > 0.0 for path in paths), sum(paths) / 1e3, medians, ratios)


def _strata(
    part: Sequence[Judged], measure: str, ours: str, theirs: str
) -> dict[str, dict[str, list[Blocks]]]:
    strata: dict[str, dict[str, list[Blocks]]] = {}
    for one in part:
        pair = [one.errors[name].blocks.get(measure) for name in (ours, theirs)]
        blocks = tuple(each[:, 0] for each in pair if each is not None and len(each))
        if len(blocks) == 2 and all(each.sum() > 0.0 for each in blocks):
            groups = strata.setdefault(one.labels["set"], {})
            groups.setdefault(one.labels["group"], []).append((blocks[0], blocks[1]))
    return strata


def labels(path: Path, attributes: Mapping[str, object], group: str = "") -> dict[str, str]:
    """What a recording is grouped by; its set is its archive's name, or that of its folder.

    OxIOD keeps each form of a recording in a folder of that name, `syn`.

    Args:
        path: of the recording.
        attributes: of the recording.
        group: from a list; empty where none is named.
    """
    file, member = split_name(path)
    folder = "oxiod" if file.parent.name == "syn" else file.parent.name
    named = group.split(" ")[0] if group else file.stem if member else folder
    known = {key: str(attributes.get(key) or "unknown") for key in get_args(By)[2:]}
    return {"set": named, "group": group or named, **known}


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")
