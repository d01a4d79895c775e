"""The paper's figures of a set: errors against parameters, their distributions, tracks.

Drawn without pyplot, like those of `stario.sequences.drawing.plots`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from stario.fusion.evaluation.results import figure_files, write_results
from stario.fusion.evaluation.scores import over_seeds, values
from stario.fusion.paper_table.runs import PROTOCOLS, TRUE_ATTITUDE, Drawn
from stario.sequences.drawing.figures import INK, apply_style, new_figure, split_at_gaps

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

Samples = Mapping[str, Mapping[str, Drawn]]
"""Tracks of networks with the true attitude, aligned with the truth, by the recording's path."""


def write_figures(
    folder: Path, scores: pd.DataFrame, parameters: Mapping[str, int], samples: Samples
) -> None:
    """Write the figures of the networks whose parameters are given; raises as `write_results`.

    Scores have the labels `network` and `seed`, and PDE in %.
    """
    colours = {name: _COLOURS[k % len(_COLOURS)] for k, name in enumerate(parameters)}
    figures = {
        "ate_parameters.png": _ate_against_parameters(scores, parameters, colours),
        "distributions.png": _distributions(scores, colours),
        "pde.png": pde_boxes(scores, colours),
    }
    if samples:
        figures["trajectories.png"] = _trajectories(scores, samples, colours)
    write_results(folder, figure_files(figures))


def _ate_against_parameters(
    scores: pd.DataFrame, parameters: Mapping[str, int], colours: Mapping[str, str]
) -> Figure:
    fig = new_figure(8.0, 5.5, "Mean ATE against parameters, true attitude")
    axes = fig.subplots()
    millions = {name: count / 1e6 for name, count in parameters.items()}
    means = over_seeds(scores).xs((TRUE_ATTITUDE, "ate_m"), level=("track", "metric"))
    for k, name in enumerate(millions):
        mean, spread = means.loc[name, ["mean", "std"]]
        axes.errorbar(
            millions[name], mean, yerr=spread, fmt=_MARKERS[k % len(_MARKERS)], ms=9, capsize=4,
            color=colours[name], label=name,
        )  # fmt: skip
    axes.set(xlabel="parameters [millions], the paper's convention", ylabel="ATE [m]", xscale="log")
    ticks = [1, 2, 3, 5, 10, 15]
    axes.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
    axes.set_xticks([], minor=True)
    axes.set_xlim(0.7 * min(millions.values()), 1.9 * max(millions.values()))
    axes.margins(y=0.15)
    axes.set_ylim(bottom=0.0)
    _legend_beside(axes)  # half of the networks have similar sizes and errors
    apply_style(axes)
    return fig


def _distributions(scores: pd.DataFrame, colours: Mapping[str, str]) -> Figure:
    fig = new_figure(11.0, 5.0, "Share of recordings below an error, true attitude")
    panels = fig.subplots(1, 2, sharey=True)
    for axes, metric, title in zip(panels, ("ate_m", "rte_m"), ("ATE [m]", "RTE [m]"), strict=True):
        for k, (name, colour) in enumerate(colours.items()):
            error = values(scores, metric, network=name, track=TRUE_ATTITUDE)
            if not len(error):
                continue
            weights = np.append(0.0, np.ones(len(error)))  # the curve begins at 0
            style = {"ls": _STYLES[k % 3], "color": colour, "lw": 1.6, "label": name}
            axes.ecdf(np.append(0.0, error), weights, **style)
        axes.set(xlabel=title, ylim=(0.0, 1.02))
        axes.set_xlim(left=0.0)
        apply_style(axes)
    panels[0].set_ylabel("share of tracks [1]")
    _legend_beside(panels[1])
    return fig


def _legend_beside(axes: Axes) -> None:
    axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def pde_boxes(scores: pd.DataFrame, colours: Mapping[str, str]) -> Figure:
    """Draw the drift at the end of the tracks of `PROTOCOLS` by network."""
    fig = new_figure(4.0 + 3.0 * len(PROTOCOLS), 5.0, "Position drift at the end, per recording")
    panels = fig.subplots(1, len(PROTOCOLS), sharey=True)
    for axes, (track, words) in zip(panels, PROTOCOLS.items(), strict=True):
        drift = [values(scores, "pde", network=name, track=track) for name in colours]
        boxes = axes.boxplot(drift, widths=0.6, patch_artist=True, showfliers=False)
        for k, colour in enumerate(colours.values()):
            boxes["boxes"][k].set(facecolor=colour, alpha=0.35, edgecolor=colour)
            boxes["medians"][k].set(color=INK, lw=1.6)
            axes.plot(np.full(len(drift[k]), k + 1), drift[k], ".", color=colour, ms=6)
        axes.set_xticks(range(1, len(drift) + 1), [*colours], rotation=60, ha="right", fontsize=8)
        axes.set_title(words, loc="left", fontsize=10)
        apply_style(axes)
    panels[0].set_ylim(bottom=0.0)  # after the last panel: it ends the shared axis's scaling
    panels[0].set_ylabel("PDE [% of the path]")
    return fig


def _trajectories(scores: pd.DataFrame, samples: Samples, colours: Mapping[str, str]) -> Figure:
    """Draw tracks of StarIO networks and R-ResNet; without it, of the first four networks."""
    columns = min(2, len(samples))
    rows = -(-len(samples) // columns)
    fig = new_figure(
        5.5 * columns, 5.2 * rows, "Tracks with true attitude, aligned by the first pose"
    )
    panels = np.ravel(fig.subplots(rows, columns, squeeze=False))
    for axes, (recording, tracks) in zip(panels, samples.items(), strict=False):
        _draw_sample(axes, tracks, scores[scores["recording"] == recording], colours)
        axes.set_title(Path(recording).name, loc="left", fontsize=10)
    for axes in panels[len(samples) :]:
        axes.remove()
    return fig


def _draw_sample(
    axes: Axes, tracks: Mapping[str, Drawn], scores: pd.DataFrame, colours: Mapping[str, str]
) -> None:
    names, first = list(tracks), next(iter(tracks.values()))
    _, path = split_at_gaps(first["time"], first["truth"])
    axes.plot(path[:, 0], path[:, 1], color="black", lw=2.0, label="truth")
    axes.plot(*path[-1], "s", color="black", ms=6, mec="white", zorder=3)
    if _BASELINE in names:
        stario = [name for name in names if name.startswith("StarIO")]
        names = [_BASELINE, *(stario or [n for n in names if n != _BASELINE])]
    for name in names[:4]:
        track, where = tracks[name]["track"], {"network": name, "track": TRUE_ATTITUDE}
        found = (values(scores, metric, **where) for metric in ("ate_m", "rte_m"))
        ate, rte = (error[0] if len(error) else np.nan for error in found)
        label = f"{name}: ATE {ate:.2f} m, RTE {rte:.2f} m"  # of the first seed, which is drawn
        axes.plot(track[:, 0], track[:, 1], color=colours[name], lw=1.2, label=label)
        axes.plot(*track[-1], "s", color=colours[name], ms=6, mec="white")
    axes.plot(*path[0], "o", mfc="white", mec=INK, ms=8)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    apply_style(axes)
