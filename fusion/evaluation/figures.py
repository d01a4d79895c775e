"""Figures of scores: networks side by side, and groups of recordings.

Drawn without pyplot, like those of `stario.sequences.drawing.plots`.
"""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from stario.fusion.evaluation.bootstrap import Interval
from stario.fusion.evaluation.groups import RATIOS, Benchmark
from stario.fusion.evaluation.networks import PROTOCOLS, TRUE_ATTITUDE, NetworkTable, Sample
from stario.fusion.evaluation.results import Files, figure_files, write_results
from stario.fusion.evaluation.scores import records, values
from stario.sequences.drawing.figures import BLUE, INK, apply_style, new_figure, split_at_gaps
from stario.sequences.files import json_text, write_json, write_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#7F5539", "#6A4C93",
    "#999999", "#000000", "#8DB600",
)  # fmt: skip
_STYLES = ("-", "--", ":")
_MARKERS = "osD^vP"
_BASELINE = "R-ResNet"


def write_table(folder: Path, table: NetworkTable) -> None:
    """Write `networks.csv`, `networks.json` and the figures; raises what `write_results` does."""
    files: Files = {
        "networks.csv": partial(write_rows, rows=table.entries),
        "networks.json": partial(write_json, obj=table.as_dict()),
        **figure_files(figures(table)),
    }
    write_results(folder, files)


def figures(table: NetworkTable) -> dict[str, Figure]:
    """Return the figures by file name."""
    drawn = {
        "ate_parameters.png": _ate_against_parameters(table),
        "distributions.png": _distributions(table),
        "pde.png": _pde_boxes(table),
    }
    if table.samples:
        drawn["trajectories.png"] = _trajectories(table)
    return drawn


def _ate_against_parameters(table: NetworkTable) -> Figure:
    fig = new_figure(8.0, 5.5, "Mean ATE against parameters, true attitude")
    axes = fig.subplots()
    for k, (network, parameters) in enumerate(table.parameters.items()):
        mean, spread = table.column(network, TRUE_ATTITUDE, "ate_m").mean_and_spread(table.scores)
        axes.errorbar(
            parameters / 1e6, mean, yerr=spread, fmt=_MARKERS[k % len(_MARKERS)], ms=9, capsize=4,
            color=_colour(k), label=network,
        )  # fmt: skip
    axes.set(xlabel="parameters [millions], the paper's convention", ylabel="ATE [m]", xscale="log")
    ticks = [1, 2, 3, 5, 10, 15]
    axes.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
    axes.set_xticks([], minor=True)
    counts = [p / 1e6 for p in table.parameters.values()]
    axes.set_xlim(0.7 * min(counts), 1.9 * max(counts))
    axes.margins(y=0.15)
    axes.set_ylim(bottom=0.0)
    # Next to the axes, not at the points: half of the networks have similar sizes and errors.
    axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    apply_style(axes)
    return fig


def _distributions(table: NetworkTable) -> Figure:
    fig = new_figure(11.0, 5.0, "Share of recordings below an error, true attitude")
    panels = fig.subplots(1, 2, sharey=True)
    for axes, metric, title in zip(panels, ("ate_m", "rte_m"), ("ATE [m]", "RTE [m]"), strict=True):
        for k, network in enumerate(table.parameters):
            error = np.sort(values(table.scores, metric, network=network, track=TRUE_ATTITUDE))
            share = np.arange(len(error) + 1) / max(len(error), 1)
            axes.plot(
                np.append(0.0, error), share, _STYLES[k % 3], drawstyle="steps-post",
                color=_colour(k), lw=1.6, label=network,
            )  # fmt: skip
        axes.set(xlabel=title, ylim=(0.0, 1.02))
        axes.set_xlim(left=0.0)
        apply_style(axes)
    panels[0].set_ylabel("share of tracks [1]")
    panels[1].legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def _pde_boxes(table: NetworkTable) -> Figure:
    fig = new_figure(4.0 + 3.0 * len(PROTOCOLS), 5.0, "Position drift at the end, per recording")
    panels = fig.subplots(1, len(PROTOCOLS), sharey=True)
    names = list(table.parameters)
    for axes, (protocol, words) in zip(panels, PROTOCOLS.items(), strict=True):
        drift = [
            100.0 * values(table.scores, "pde", network=name, track=protocol) for name in names
        ]
        boxes = axes.boxplot(drift, widths=0.6, patch_artist=True, showfliers=False)
        for k, (box, median) in enumerate(zip(boxes["boxes"], boxes["medians"], strict=True)):
            box.set(facecolor=_colour(k), alpha=0.35, edgecolor=_colour(k))
            median.set(color=INK, lw=1.6)
            axes.plot(np.full(len(drift[k]), k + 1), drift[k], ".", color=_colour(k), ms=6)
        axes.set_xticks(range(1, len(names) + 1), names, rotation=60, ha="right", fontsize=8)
        axes.set_title(words, loc="left", fontsize=10)
        apply_style(axes)
    panels[0].set_ylim(bottom=0.0)  # after the last panel: it ends the shared axis's scaling
    panels[0].set_ylabel("PDE [% of the path]")
    return fig


def _trajectories(table: NetworkTable) -> Figure:
    """Draw tracks of StarIO networks and R-ResNet; without it, of the first four networks."""
    samples = table.samples
    columns = min(2, len(samples))
    rows = math.ceil(len(samples) / columns)
    fig = new_figure(
        5.5 * columns, 5.2 * rows, "Tracks with true attitude, aligned by the first pose"
    )
    panels = np.ravel(fig.subplots(rows, columns, squeeze=False))
    for axes, sample in zip(panels, samples, strict=False):
        _draw_sample(axes, sample, table)
    for axes in panels[len(samples) :]:
        axes.remove()
    return fig


def _draw_sample(axes: Axes, sample: Sample, table: NetworkTable) -> None:
    truth, length = sample.truth, sample.truth.path_length()
    _, path = split_at_gaps(truth.time, truth.position_W, truth.valid)
    axes.plot(path[:, 0], path[:, 1], color="black", lw=2.0, label=f"truth, {length:.0f} m")
    known = truth.position_W[truth.valid]
    axes.plot(*known[-1, :2], "s", color="black", ms=6, mec="white", zorder=3)
    names = list(sample.tracks)
    if _BASELINE in names:
        stario = [name for name in names if name.startswith("StarIO")]
        names = [_BASELINE, *(stario or [n for n in names if n != _BASELINE])]
    scores = table.scores
    shown = scores[(scores["recording"] == sample.recording) & (scores["track"] == TRUE_ATTITUDE)]
    errors = shown.groupby(["network", "metric"])["value"].first()  # of the weights that are drawn
    for name in names[:4]:
        track, colour = sample.tracks[name], _colour(list(table.parameters).index(name))
        label = f"{name}: ATE {errors[name, 'ate_m']:.2f} m, RTE {errors[name, 'rte_m']:.2f} m"
        axes.plot(track[:, 0], track[:, 1], color=colour, lw=1.2, label=label)
        axes.plot(*track[-1, :2], "s", color=colour, ms=6, mec="white")
    axes.plot(*known[0, :2], "o", mfc="white", mec=INK, ms=8)
    axes.set_title(sample.recording, loc="left", fontsize=10)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    apply_style(axes)


def _colour(index: int) -> str:
    return _COLOURS[index % len(_COLOURS)]


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
