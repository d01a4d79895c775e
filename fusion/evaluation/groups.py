"""Benchmark of networks alone by groups of recordings: sets, people, devices, places.

`displacement_error` defines the errors, `stario.fusion.evaluation.bootstrap` the confidence
intervals.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from stario.fusion.evaluation import bootstrap
from stario.fusion.evaluation.bootstrap import Interval, paired_ratio
from stario.fusion.evaluation.displacement_error import (
    FIGURES,
    HORIZONS,
    known_truth,
    recording_errors,
    usable_streams,
)
from stario.fusion.evaluation.pedestrian import Model, PedestrianDeadReckoning, piece_of
from stario.fusion.evaluation.results import Files, figure_files, write_results
from stario.fusion.evaluation.scores import Column, joined, parts, scored, table
from stario.fusion.navigator import Navigator
from stario.sequences.drawing.figures import BLUE, INK, apply_style, new_figure
from stario.sequences.files import json_text, write_json
from stario.sequences.readers.archive import split_name
from stario.sequences.sequence import ImuSequence
from stario.sequences.truth.problems import warn_of_truth

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

_ATTRIBUTES = ("person", "device", "place", "carry")
"""Attributes of a recording that it can be grouped by, besides its set and group."""

_UNKNOWN = "unknown"
"""Label of a recording whose person, device, place or carry is not known."""

_NOT_COMPARED = (
    "not compared, because the ground truth moves by less than a metre, or has neither 2 s of "
    "known positions nor three waypoints within an unbroken stretch of samples"
)

RATIOS = {f"ratio_{horizon}s": f"rms_{horizon}s_m" for horizon in HORIZONS}
"""Ratios of errors, and the figure that each is of."""

_DECISIVE = "ratio_10s"
_MAX_GROUP_RATIO, _MIN_GROUPS = 1.1, 3
"""Largest acceptable ratio of a group, and minimum number of groups for a verdict: intervals from
fewer do not generalise to others."""

WORDS: dict[str, str] = {
    **FIGURES,
    "medians": "over the recordings of a group",
    "ratio": "root mean square errors, ours over theirs: geometric mean over groups (for all sets, "
    f"over sets); [{bootstrap.CONFIDENCE:.0%} interval] of {bootstrap.REPLICATES} bootstrap "
    "replicates that draw groups, recordings and blocks of 30 s; for waypoints, their residuals "
    "replace the 10 s errors",
}
"""Meaning of each figure."""

_COLUMNS = (
    Column("n", "recordings", ".0f"),
    Column("km", "path_km"),
    Column("fit [m]", "ate_fit_m"),
    Column("fit [%]", "ate_fit_percent"),
    Column("first [m]", "ate_first_m"),
    Column("20 s [%]", "stretch_percent"),
    Column("length", "length_ratio", ".3f"),
    Column("1 s [m]", "rms_1s_m", ".3f"),
    Column("10 s [m]", "rms_10s_m"),
    Column("30 s [m]", "rms_30s_m"),
    Column("direction [deg]", "direction_deg", ".0f"),
    Column("NIS", "nis"),
    Column("filtered NIS", "nis_filtered"),
)


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Networks compared by groups of recordings.

    Attributes:
        scores: `path_m` and `FIGURES` of each recording, named by its path, with its set, person,
            device, place and carry, and the kind of its `truth`; the weights are the tracks.
        blocks: blocks of squared errors of each recording and horizon.
        by: label that recordings are grouped by.
        ours: the weights.
        theirs: those that they are compared with, if any.
    """

    scores: pd.DataFrame
    blocks: pd.DataFrame
    by: str
    ours: str
    theirs: str | None

    @cached_property
    def rows(self) -> pd.DataFrame:
        """Rows "theirs", if any, and "ours" (`role`) of each `group`; then over all groups.

        The other columns are the `weights`; the medians of `FIGURES` over recordings; the number of
        `recordings` compared, without those with fewer than three waypoints; the length `path_km`
        of their true paths; whether the row is `pooled` over all groups, if there are several; and
        in those of ours the `RATIOS` of errors to theirs, as `Interval`s where there are any. For
        waypoints, the residuals replace the 10 s errors.
        """
        found, rows = parts(self.scores, self.by), []
        for k, (name, part) in enumerate(found):
            paths = part.loc[part["track"] == self.ours, "path_m"]
            known = {"recordings": int((paths > 0.0).sum()), "path_km": paths.sum() / 1e3}
            medians = part.groupby("track")[[*FIGURES]].median()
            for role, weights in (("theirs", self.theirs), ("ours", self.ours)):
                if weights:
                    about = {"group": name, "pooled": 0 < k == len(found) - 1, "role": role}
                    ratios = self._ratios(part) if role == "ours" else dict.fromkeys(RATIOS)
                    figures = known | medians.loc[weights].to_dict() | ratios
                    rows.append({**about, "weights": weights, **figures})
        return pd.DataFrame(rows)

    def _ratios(self, part: pd.DataFrame) -> dict[str, Interval | None]:
        blocks = self.blocks[self.blocks["recording"].isin(part["recording"])]
        of = {key: blocks[blocks["metric"] == metric] for key, metric in RATIOS.items()}
        return {
            key: paired_ratio(errors, self.ours, self.theirs) if self.theirs else None
            for key, errors in of.items()
        }

    def as_dict(self) -> dict[str, object]:
        """Return the result as plain values, including the recordings."""
        return {
            "ours": self.ours,
            "theirs": self.theirs,
            "verdict": verdict(self.rows),
            "groups": self.rows.to_dict("records"),
            "recordings": self.scores.rename(columns={"track": "weights"}).to_dict("records"),
            "words": WORDS,
        }

    def text(self) -> str:
        """Return for every group rows "theirs" and "ours", the ratios, the verdict, the words."""
        rows = self.rows.to_dict("records")
        parts = (((row["group"], row["role"]), pd.DataFrame([row])) for row in rows)
        head, *body = table(parts, _COLUMNS, ("", "")).splitlines()
        lines = [head]
        for line, row in zip(body, rows, strict=True):
            lines.append(line)
            for horizon in HORIZONS:
                if isinstance(ratio := row[f"ratio_{horizon}s"], Interval):
                    lines.append(f"{row['group']}: ratio over {horizon} s: {ratio:.3f}")
        lines += [conclusion] if (conclusion := verdict(self.rows)) else []
        lines += [f"ours: {self.ours}", *([f"theirs: {self.theirs}"] if self.theirs else [])]
        return "\n".join([*lines, *(f"{key}: {words}." for key, words in WORDS.items())])


def verdict(rows: pd.DataFrame) -> str:
    """Return the verdict on replacing the weights compared with; empty without several groups.

    Weights are accepted if the pooled interval is below 1 and no group is worse by over a
    tenth.
    """
    compared = [r for r in rows.to_dict("records") if isinstance(r[_DECISIVE], Interval)]
    ratios = {str(r["group"]): r[_DECISIVE] for r in compared if not r["pooled"]}
    pooled = next((r[_DECISIVE] for r in compared if r["pooled"]), None)
    if pooled is None:
        return ""
    if len(ratios) < _MIN_GROUPS:
        return f"not decided, {len(ratios)} groups are too few: pooled {pooled:.3f} over 10 s"
    worst = max(ratios, key=lambda name: ratios[name].ratio)
    accepted = pooled.high < 1.0 and ratios[worst].ratio <= _MAX_GROUP_RATIO
    words = f"pooled {pooled:.3f} over 10 s, worst {worst} {ratios[worst]:.3f}"
    return f"{'accepted' if accepted else 'not accepted'}: {words}"


def alone_on(
    sequence: ImuSequence,
    path: Path,
    group: str,
    model: Callable[[str, str], Model],
    weights: Collection[str],
    filtered: bool = False,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Score networks alone on a recording; return rows of a benchmark's scores and of its blocks.

    Args:
        sequence: the recording.
        path: its path.
        group: its group in a list; empty for that of its person or set.
        model: function that returns the network by the name of its weights for a group: networks
            differ between groups if each group was held out of training in turn.
        weights: names of the weights.
        filtered: whether the filter is run for its mean NIS, which is slow.
    """
    streams, (kind, _) = usable_streams(sequence), known_truth(sequence)
    warn_of_truth(sequence)
    named = labels(path, sequence.attributes, group)
    group = named["group"]
    unit = {"set": named["set"], "group": group, "recording": str(path)}
    figures, blocks = {}, []
    for name in weights:
        network = model(name, group)
        pieces = [piece_of(network, stream) for stream in streams]
        figures[name], errors = recording_errors(sequence, pieces)
        if filtered and not isinstance(network, PedestrianDeadReckoning):
            nis = Navigator(network, backend="ekf").run(sequence).nis
            figures[name]["nis_filtered"] = nis or np.nan
        blocks.append(errors.assign(**unit, network=name, seed=0))
    return scored(str(path), figures, **named, truth=kind), joined(blocks)


def benchmark(
    found: Sequence[tuple[pd.DataFrame, pd.DataFrame]],
    by: str,
    ours: str,
    theirs: str | None = None,
) -> Benchmark:
    """Return the benchmark of the recordings that `alone_on` scored; at least one.

    Recordings in which nothing could be compared are named in one warning.
    """
    scores, blocks = map(joined, zip(*found, strict=True))
    compared = scores.groupby("recording", sort=False)["path_m"].any()
    if len(still := compared.index[~compared]):
        several = f"{len(still)} of {len(compared)} recordings, the first "
        log.warning("%s%s: %s", several if len(still) > 1 else "", still[0], _NOT_COMPARED)
    return Benchmark(scores, blocks, by, ours, theirs)


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
    known = {key: str(attributes.get(key) or _UNKNOWN) for key in _ATTRIBUTES}
    of_person = set_name if known["person"] == _UNKNOWN else f"{set_name} {known['person']}"
    return {"set": set_name, "group": group or of_person, **known}


def write_benchmark(folder: Path, found: Benchmark) -> None:
    """Write `groups.csv`, `recordings.csv`, `groups.json` and `groups.png` into a folder.

    Raises what `write_results` does.
    """
    content = found.as_dict()
    flat = json.loads(json_text(content["groups"]))  # ratios become tables, unknown values None
    groups = pd.json_normalize(flat, sep="_").drop(columns=[*RATIOS], errors="ignore")
    files: Files = {
        "groups.csv": partial(groups.to_csv, index=False),
        "recordings.csv": partial(found.scores.to_csv, index=False, na_rep="nan"),
        "groups.json": partial(write_json, obj=content),
        **figure_files({"groups.png": groups_figure(found)}),
    }
    write_results(folder, files)


_BEFORE, _AFTER = "#8C8C8C", BLUE

_PANELS = (
    (
        "error after a yaw fit [% of the path]\n(position truth: within 20 s)",
        ("ate_fit_percent", "stretch_percent"),
    ),
    ("length of the track\nover that of the truth", ("length_ratio",)),
)


def groups_figure(found: Benchmark) -> Figure:
    """Draw a line for each group: medians of both weights, paired ratio with its interval."""
    rows, theirs = found.rows, found.theirs
    shown = rows[rows["role"] == "ours"]
    groups = rows[~rows["pooled"]].set_index("weights")
    fig = new_figure(12.0 if theirs else 9.0, 1.8 + 0.55 * len(shown), "")
    panels = fig.subplots(1, 3 if theirs else 2, sharey=True)
    for axes, (title, keys) in zip(panels, _PANELS, strict=False):
        known = groups[list(keys)].bfill(axis=1).iloc[:, 0]
        _draw_medians(axes, known[[found.ours]], known[[theirs]] if theirs else None)
        axes.set_title(title, loc="left", fontsize=10)
    panels[0].set_xlim(left=0.0)
    panels[1].axvline(1.0, color=INK, lw=1.0)
    if theirs:
        _draw_ratios(panels[2], shown["ratio_10s"].to_list())
    else:
        shown = shown[~shown["pooled"]]
    names = [f"{row['group']} ({row['recordings']})" for row in shown.to_dict("records")]
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    handles, labels = panels[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return fig


def _draw_medians(axes: Axes, ours: pd.Series[float], theirs: pd.Series[float] | None) -> None:
    """Draw the medians of each group, of weights by which the series are named."""
    label = str(ours.index[0])
    if theirs is not None:
        for k, ends in enumerate(zip(theirs, ours, strict=True)):
            axes.plot(ends, [k, k], color="#CCCCCC", lw=3.0, zorder=1)
        axes.plot(theirs, range(len(theirs)), "o", color=_BEFORE, ms=8,
                  label=f"before: {theirs.index[0]}")  # fmt: skip
        label = f"after: {label}"
    axes.plot(ours, range(len(ours)), "o", color=_AFTER, ms=8, label=label)
    for k, value in enumerate(ours):
        axes.annotate(f"{value:.2f}", (value, k), (0, 8), textcoords="offset points",
                      ha="center", fontsize=8, color=_AFTER)  # fmt: skip
    axes.margins(x=0.12)
    apply_style(axes)


def _draw_ratios(axes: Axes, ratios: list[Interval | None]) -> None:
    known = {k: r for k, r in enumerate(ratios) if isinstance(r, Interval)}
    for k, ratio in known.items():
        axes.plot([ratio.low, ratio.high], [k, k], color=_AFTER, lw=2.0)
        axes.plot(ratio.ratio, k, "o", color=_AFTER, ms=8)
    axes.axvline(1.0, color=INK, lw=1.0)
    axes.set_xscale("log")
    limits = [x for r in known.values() for x in (r.low, r.ratio, r.high) if np.isfinite(x)]
    ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
             if min([0.7, *limits]) <= t <= max([1.5, *limits])]  # fmt: skip
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    title = "error over 10 s, after / before, 95 % interval\n(waypoints: residuals)"
    axes.set_title(title, loc="left", fontsize=10)
    apply_style(axes)
