"""Figures of groups of recordings.

Drawn without pyplot, like those of `stario.sequences.drawing.plots`.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from stario.fusion.evaluation.bootstrap import Interval
from stario.fusion.evaluation.groups import RATIOS, Benchmark
from stario.fusion.evaluation.results import Files, figure_files, write_results
from stario.fusion.evaluation.scores import records
from stario.sequences.drawing.figures import BLUE, INK, apply_style, new_figure
from stario.sequences.files import json_text, write_json, write_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write_benchmark(folder: Path, found: Benchmark) -> None:
    """Write `groups.csv`, `recordings.csv`, `groups.json` and `groups.png` into a folder.

    Raises what `write_results` does.
    """
    content = found.as_dict()
    flat = json.loads(json_text(content["groups"]))  # ratios become tables, unknown values None
    groups = pd.json_normalize(flat, sep="_").drop(columns=[*RATIOS], errors="ignore")
    files: Files = {
        "groups.csv": partial(groups.to_csv, index=False),
        "recordings.csv": partial(write_rows, rows=records(found.scores)),
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
