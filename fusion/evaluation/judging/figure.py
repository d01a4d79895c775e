"""Figure of the errors by group, before and after, with the interval of their ratio."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stario.fusion.evaluation.judging.judge import Row
from stario.sequences.drawing.figures import BLUE, INK, apply_style, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BEFORE, _AFTER = "#8C8C8C", BLUE

_PANELS = (
    (
        "error after a yaw fit [% of the path]\n(position truth: within 20 s)",
        ("ate_fit_percent", "stretch_percent"),
    ),
    ("length of the track\nover that of the truth", ("length_ratio",)),
)


def groups_figure(rows: Sequence[Row], ours: str, theirs: str | None) -> Figure:
    """Draw a line for each group: medians of both weights, paired ratio with its interval."""
    groups = [row for row in rows if not row.pooled]
    fig = new_figure(12.0 if theirs else 9.0, 1.8 + 0.55 * len(rows), "")
    panels = fig.subplots(1, 3 if theirs else 2, sharey=True)
    for axes, (title, keys) in zip(panels, _PANELS, strict=False):
        _medians(axes, groups, keys, ours, theirs)
        axes.set_title(title, loc="left", fontsize=10)
    panels[0].set_xlim(left=0.0)
    panels[1].axvline(1.0, color=INK, lw=1.0)
    shown = groups
    if theirs:
        shown = [*groups, *(row for row in rows if row.pooled)]
        _ratios(panels[2], shown)
    panels[0].set_yticks(range(len(shown)), [f"{row.name} ({row.recordings})" for row in shown])
    panels[0].set_ylim(len(shown) - 0.5, -0.5)
    handles, labels = panels[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return fig


def _medians(
    axes: Axes, rows: Sequence[Row], keys: tuple[str, ...], ours: str, theirs: str | None
) -> None:
    for k, row in enumerate(rows):
        after, before = (_first(row, name, keys) for name in (ours, theirs or ours))
        axes.plot([before, after], [k, k], color="#CCCCCC", lw=3.0, zorder=1)
        if theirs:
            label = f"before: {theirs}" if k == 0 else None
            axes.plot(before, k, "o", color=_BEFORE, ms=8, label=label)
        axes.plot(after, k, "o", color=_AFTER, ms=8, label=f"after: {ours}" if k == 0 else None)
        axes.annotate(f"{after:.2f}", (after, k), (0, 8), textcoords="offset points",
                      ha="center", fontsize=8, color=_AFTER)  # fmt: skip
    axes.margins(x=0.12)
    apply_style(axes)


def _ratios(axes: Axes, rows: Sequence[Row]) -> None:
    for k, row in enumerate(rows):
        found = row.ratios.get("rms_10s_m")
        if found is not None:
            axes.plot([found.low, found.high], [k, k], color=_AFTER, lw=2.0)
            axes.plot(found.ratio, k, "o", color=_AFTER, ms=8)
    axes.axvline(1.0, color=INK, lw=1.0)
    axes.set_xscale("log")
    limits = [x for row in rows if (r := row.ratios.get("rms_10s_m")) for x in (r.low, r.high)]
    ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
             if min([0.7, *limits]) <= t <= max([1.5, *limits])]  # fmt: skip
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    title = "error over 10 s, after / before, 95 % interval\n(waypoints: residuals)"
    axes.set_title(title, loc="left", fontsize=10)
    apply_style(axes)


def _first(row: Row, weights: str, keys: tuple[str, ...]) -> float:
    values = (row.medians[weights][key] for key in keys)
    return next((value for value in values if np.isfinite(value)), float("nan"))
