"""Benchmark of networks alone by groups of recordings: sets, people, devices, places.

Each recording is aligned with its truth once and run through every network. `displacement_error`
defines the errors, `stario.fusion.evaluation.bootstrap` the confidence intervals.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd

from stario.fusion.evaluation.benchmark.aligned import Aligned, RecordingPredictor, predictions
from stario.fusion.evaluation.benchmark.displacement_error import (
    FIGURES,
    HORIZONS,
    RecordingErrors,
    recording_errors,
)
from stario.fusion.evaluation.bootstrap import (
    CONFIDENCE,
    REPLICATES,
    Interval,
    block_rows,
    paired_ratio,
)
from stario.fusion.evaluation.scores import joined, parts, records, scored, wide
from stario.fusion.imu.stateful import Predictor
from stario.fusion.navigator import Navigator
from stario.sequences.datasets.batch import Skipped, without_skipped
from stario.sequences.drawing.text_table import aligned, figure
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


RATIOS = {f"ratio_{horizon}s": f"rms_{horizon}s_m" for horizon in HORIZONS}
"""Ratios of errors, and the figure that each is of."""

_DECISIVE = "ratio_10s"
_MAX_GROUP_RATIO = 1.1

WORDS: dict[str, str] = {
    **FIGURES,
    "medians": "over the recordings of a group",
    "ratio": "root mean square errors, ours over theirs: geometric mean over groups (for all sets, "
    f"over sets); [{CONFIDENCE:.0%} interval] of {REPLICATES} bootstrap replicates that draw "
    "groups, recordings and blocks of 30 s; for waypoints, their residuals replace the 10 s errors",
}
"""Meaning of each figure."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Scores of networks, whose weights are the tracks.

    Attributes:
        scores: `path_m` and `FIGURES` of each recording, named by its path, with its set, person,
            device, place and carry, and the kind of its `truth`.
        blocks: blocks of squared errors of each recording and horizon.
    """

    scores: pd.DataFrame
    blocks: pd.DataFrame

    def rows(self, by: By, ours: str, theirs: str | None) -> pd.DataFrame:
        """Return rows "theirs", if any, and "ours" (`role`) of each `group`; then over all groups.

        The other columns are the `weights`; the medians of `FIGURES` over recordings; the number of
        `recordings` compared, without those with fewer than three waypoints; the length `path_km`
        of their true paths; whether the row is `pooled` over all groups, if there are several; and
        in those of ours the `RATIOS` of errors to theirs, as `Interval`s where there are any. For
        waypoints, the residuals replace the 10 s errors.
        """
        found = parts(wide(self.scores), by, POOLED)
        return pd.DataFrame(
            row
            for k, (name, part) in enumerate(found)
            for row in self._rows(name, part, 0 < k == len(found) - 1, ours, theirs)
        )

    def _rows(
        self, name: str, part: pd.DataFrame, pooled: bool, ours: str, theirs: str | None
    ) -> list[dict[str, Any]]:
        medians = part.groupby("track")[[*FIGURES]].median().to_dict("index")
        blocks = self.blocks[self.blocks["recording"].isin(part["recording"])]
        ratios = {
            key: theirs and paired_ratio(blocks[blocks["metric"] == metric], ours, theirs)
            for key, metric in RATIOS.items()
        }
        paths = part.loc[part["track"] == ours, "path_m"]
        known = {"recordings": int((paths > 0.0).sum()), "path_km": paths.sum() / 1e3}
        return [
            {"group": name, "pooled": pooled, "role": role, "weights": weights}
            | known
            | medians[weights]
            | (ratios if role == "ours" else dict.fromkeys(RATIOS))
            for role, weights in (("theirs", theirs), ("ours", ours))
            if weights
        ]


def benchmark(
    recordings: Iterable[Aligned | Skipped],
    models: Mapping[str, Callable[[str], Predictor | RecordingPredictor]],
    groups: Mapping[Path, str],
    read: Callable[[Path], ImuSequence] | None = None,
) -> tuple[Benchmark | None, list[Skipped]]:
    """Run every recording through every network; return None if there is no recording.

    Args:
        recordings: aligned recordings, and those skipped.
        models: by name of the weights, a function that returns the network for a group: networks
            differ between groups if each group was held out of training in turn.
        groups: group of each recording, by path; the name of the set where missing.
        read: function that reads a path; if given, the EKF is run for its mean NIS, which is slow.
    """
    skipped: list[Skipped] = []
    scores: list[pd.DataFrame] = []
    blocks = [block_rows([], **dict.fromkeys(("set", "group", "recording", "network", "metric")))]
    still: list[Path] = []
    for recording in without_skipped(recordings, skipped):
        named = labels(recording.path, recording.attributes, groups.get(recording.path, ""))
        unit = {"set": named["set"], "group": named["group"], "recording": str(recording.path)}
        errors = {n: _errors(model(named["group"]), recording, read) for n, model in models.items()}
        figures = {n: {"path_m": found.path_m, **found.figures} for n, found in errors.items()}
        others = {key: name for key, name in named.items() if key != "group"}
        scores.append(
            scored(str(recording.path), figures, named["group"], **others, truth=recording.kind)
        )
        for name, found in errors.items():
            for horizon, sums in found.blocks.items():
                metric = f"rms_{horizon}s_m"
                blocks.append(block_rows(sums, **unit, network=name, seed=0, metric=metric))
        if not any(found.path_m > 0.0 for found in errors.values()):
            still.append(recording.path)
    _warn_of_not_compared(still, len(scores))
    return Benchmark(joined(scores), joined(blocks)) if scores else None, skipped


def _warn_of_not_compared(paths: Sequence[Path], count: int) -> None:
    """Log one warning about all recordings in which nothing could be compared."""
    if len(paths) > 1:
        message = "%d of %d recordings, the first %s: %s"
        log.warning(message, len(paths), count, paths[0], _NOT_COMPARED)
    elif paths:
        log.warning("%s: %s", paths[0], _NOT_COMPARED)


def _errors(
    model: Predictor | RecordingPredictor,
    aligned: Aligned,
    read: Callable[[Path], ImuSequence] | None,
) -> RecordingErrors:
    found = recording_errors(aligned, predictions(model, aligned))
    if read is not None and not isinstance(model, RecordingPredictor):
        navigator = Navigator(model, backend="ekf")
        found.figures["nis_ekf"] = navigator.run(read(aligned.path)).nis or np.nan
    return found


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


_MIN_GROUPS = 3
"""Minimum number of groups for a verdict: intervals from fewer do not generalise to others."""


def verdict(rows: pd.DataFrame) -> str:
    """Return the verdict on replacing the weights compared with; empty without several groups.

    Weights are accepted if the pooled interval is below 1 and no group is worse by over a tenth.
    """
    compared = [r for r in rows.to_dict("records") if isinstance(r[_DECISIVE], Interval)]
    ratios = {str(r["group"]): r[_DECISIVE] for r in compared if not r["pooled"]}
    pooled = next((r[_DECISIVE] for r in compared if r["pooled"]), None)
    if pooled is None:
        return ""
    worst = max(ratios, key=lambda name: ratios[name].ratio)
    accepted = pooled.high < 1.0 and ratios[worst].ratio <= _MAX_GROUP_RATIO
    if len(ratios) < _MIN_GROUPS:
        return f"not decided, {len(ratios)} groups are too few: pooled {pooled:.3f} over 10 s"
    words = f"pooled {pooled:.3f} over 10 s, worst {worst} {ratios[worst]:.3f}"
    return f"{'accepted' if accepted else 'not accepted'}: {words}"


def benchmark_dict(
    found: Benchmark, rows: pd.DataFrame, ours: str, theirs: str | None
) -> dict[str, object]:
    """Return the result as plain values, including the recordings."""
    return {
        "ours": ours,
        "theirs": theirs,
        "verdict": verdict(rows),
        "groups": rows.to_dict("records"),
        "recordings": records(found.scores.rename(columns={"track": "weights"})),
        "words": WORDS,
    }


_TITLES = {
    "ate_fit_m": ("fit [m]", ".2f"),
    "ate_fit_percent": ("fit [%]", ".2f"),
    "ate_first_m": ("first [m]", ".2f"),
    "stretch_percent": ("20 s [%]", ".2f"),
    "length_ratio": ("length", ".3f"),
    "rms_1s_m": ("1 s [m]", ".3f"),
    "rms_10s_m": ("10 s [m]", ".2f"),
    "rms_30s_m": ("30 s [m]", ".2f"),
    "direction_deg": ("direction [deg]", ".0f"),
    "nis": ("NIS", ".2f"),
    "nis_ekf": ("EKF NIS", ".2f"),
}
"""Titles and formats of the figures of a benchmark."""


def benchmark_text(rows: pd.DataFrame, ours: str, theirs: str | None) -> str:
    """Return for every group rows "theirs" and "ours", then the ratios, the verdict, the words."""
    cells = [["", "", "n", "km", *(title for title, _ in _TITLES.values())]]
    for row in rows.to_dict("records"):
        known = [row["group"], row["role"], str(row["recordings"])]
        found = [figure(row[key], form) for key, (_, form) in _TITLES.items()]
        cells.append([*known, f"{row['path_km']:.2f}", *found])
    head, *body = aligned(cells)
    lines = [head]
    for line, row in zip(body, rows.to_dict("records"), strict=True):
        lines.append(line)
        for key, metric in RATIOS.items():
            if isinstance(row[key], Interval):
                title = _TITLES[metric][0].split(" [")[0]
                lines.append(f"{row['group']}: ratio over {title}: {row[key]:.3f}")
    if conclusion := verdict(rows):
        lines.append(conclusion)
    lines += [f"ours: {ours}", *([f"theirs: {theirs}"] if theirs else [])]
    return "\n".join([*lines, *(f"{key}: {words}." for key, words in WORDS.items())])
