"""Results of judging by groups as text, CSV, JSON and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from stario.fusion.evaluation.folders import fresh_folder
from stario.fusion.evaluation.judging.bootstrap import CONFIDENCE, REPLICATES
from stario.fusion.evaluation.judging.displacement_error import FIGURES
from stario.fusion.evaluation.judging.judge import RecordingResult, Row
from stario.sequences.drawing.figures import BLUE, INK, apply_style, new_figure, save_figure
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.files import write_json, write_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = {
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

_DECISIVE = "rms_10s_m"
_MAX_GROUP_RATIO = 1.1

WORDS = {
    **FIGURES,
    "medians": "over the recordings of a group",
    "ratio": "root mean square errors, ours over theirs: geometric mean over groups (for all sets, "
    f"over sets); [{CONFIDENCE:.0%} interval] of {REPLICATES} bootstrap replicates that draw "
    "groups, recordings and blocks of 30 s; for waypoints, their residuals replace the 10 s errors",
}
"""Meaning of each figure."""


@dataclass(frozen=True, eq=False)
class JudgingResult:
    """Result of judging a set of weights.

    Attributes:
        ours: name of the weights.
        theirs: name of the weights compared with, or None.
        rows: results of the groups.
        judged: results of the recordings.
    """

    ours: str
    theirs: str | None
    rows: list[Row]
    judged: list[RecordingResult]


def judgement_text(found: JudgingResult) -> str:
    """Return the table as text: for every group rows "theirs" and "ours", then the ratios."""
    weights = {"theirs": found.theirs, "ours": found.ours}
    labels = {label: name for label, name in weights.items() if name is not None}
    table = [["", "", "n", "km", *(title for title, _ in _COLUMNS.values())]]
    for row in found.rows:
        for label, name in labels.items():
            cells = [figure(row.medians[name][key], form) for key, (_, form) in _COLUMNS.items()]
            table.append([row.name, label, str(row.recordings), f"{row.path_km:.2f}", *cells])
    head, *body = aligned(table)
    lines = [head]
    for k, row in enumerate(found.rows):
        lines += body[k * len(labels) : (k + 1) * len(labels)]
        for key, interval in row.ratios.items():
            title = _COLUMNS[key][0].split(" [")[0]
            lines.append(f"{row.name}: ratio over {title}: {interval:.3f}")
    if conclusion := verdict(found.rows):
        lines.append(conclusion)
    names = [f"ours: {found.ours}"] + ([f"theirs: {found.theirs}"] if found.theirs else [])
    return "\n".join([*lines, *names, *(f"{key}: {text}." for key, text in WORDS.items())])


_MIN_GROUPS = 3
"""Minimum number of groups for a verdict: intervals from fewer do not generalise to others."""


def verdict(rows: Sequence[Row]) -> str:
    """Return the verdict on replacing the weights compared with; empty without several groups.

    Weights are accepted if the pooled interval is below 1 and no group is worse by over a tenth.
    """
    compared = [row for row in rows if _DECISIVE in row.ratios]
    ratios = {row.name: row.ratios[_DECISIVE] for row in compared if not row.pooled}
    pooled = next((row.ratios[_DECISIVE] for row in compared if row.pooled), None)
    if pooled is None:
        return ""
    worst = max(ratios, key=lambda name: ratios[name].ratio)
    accepted = pooled.high < 1.0 and ratios[worst].ratio <= _MAX_GROUP_RATIO
    if len(ratios) < _MIN_GROUPS:
        return f"not decided, {len(ratios)} groups are too few: pooled {pooled:.3f} over 10 s"
    words = f"pooled {pooled:.3f} over 10 s, worst {worst} {ratios[worst]:.3f}"
    return f"{'accepted' if accepted else 'not accepted'}: {words}"


def judgement_dict(found: JudgingResult) -> dict[str, object]:
    """Return the result as plain values, including the recordings."""
    return {
        "ours": found.ours,
        "theirs": found.theirs,
        "verdict": verdict(found.rows),
        "groups": [asdict(row) for row in found.rows],
        "recordings": [_recording(result) for result in found.judged],
        "words": WORDS,
    }


def write_judgement(folder: Path, found: JudgingResult) -> None:
    """Write `groups.csv`, `recordings.csv`, `groups.json` and `groups.png` into a folder.

    Raises:
        InputError: as `fresh_folder`.
    """
    fresh_folder(folder)
    rows = [
        {"group": row.name, "weights": name, "recordings": row.recordings, "path_km": row.path_km}
        | figures
        | (_ratios(row) if name == found.ours else {})
        for row in found.rows
        for name, figures in row.medians.items()
    ]
    single = [
        {"recording": result.path.name, **result.labels, "weights": name, "path_m": errors.path_m}
        | errors.figures
        for result in found.judged
        for name, errors in result.errors.items()
    ]
    write_rows(folder / "groups.csv", rows)
    write_rows(folder / "recordings.csv", single)
    write_json(folder / "groups.json", judgement_dict(found))
    save_figure(groups_figure(found.rows, found.ours, found.theirs), folder / "groups.png")


def _recording(result: RecordingResult) -> dict[str, object]:
    figures = {name: errors.figures for name, errors in result.errors.items()}
    kind, path_m = next((e.kind, e.path_m) for e in result.errors.values())
    return {"recording": str(result.path), **result.labels, "truth": kind, "path_m": path_m} | {
        "figures": figures
    }


def _ratios(row: Row) -> dict[str, float]:
    return {
        f"{key}_{part}": getattr(interval, part)
        for key, interval in row.ratios.items()
        for part in ("ratio", "low", "high")
    }


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
        _draw_medians(axes, groups, keys, ours, theirs)
        axes.set_title(title, loc="left", fontsize=10)
    panels[0].set_xlim(left=0.0)
    panels[1].axvline(1.0, color=INK, lw=1.0)
    shown = groups
    if theirs:
        shown = [*groups, *(row for row in rows if row.pooled)]
        _draw_ratios(panels[2], shown)
    panels[0].set_yticks(range(len(shown)), [f"{row.name} ({row.recordings})" for row in shown])
    panels[0].set_ylim(len(shown) - 0.5, -0.5)
    handles, labels = panels[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return fig


def _draw_medians(
    axes: Axes, rows: Sequence[Row], keys: tuple[str, ...], ours: str, theirs: str | None
) -> None:
    for k, row in enumerate(rows):
        after, before = (_first(row, name, keys) for name in (ours, theirs or ours))
        axes.plot([before, after], [k, k], color="#CCCCCC", lw=3.0, zorder=1)
        if theirs:
            label = f"before: {theirs}" if k == 0 else None
            axes.plot(before, k, "o", color=_BEFORE, ms=8, label=label)
        label = (f"after: {ours}" if theirs else ours) if k == 0 else None
        axes.plot(after, k, "o", color=_AFTER, ms=8, label=label)
        axes.annotate(f"{after:.2f}", (after, k), (0, 8), textcoords="offset points",
                      ha="center", fontsize=8, color=_AFTER)  # fmt: skip
    axes.margins(x=0.12)
    apply_style(axes)


def _draw_ratios(axes: Axes, rows: Sequence[Row]) -> None:
    for k, row in enumerate(rows):
        ratio = row.ratios.get("rms_10s_m")
        if ratio is not None:
            axes.plot([ratio.low, ratio.high], [k, k], color=_AFTER, lw=2.0)
            axes.plot(ratio.ratio, k, "o", color=_AFTER, ms=8)
    axes.axvline(1.0, color=INK, lw=1.0)
    axes.set_xscale("log")
    found = [row.ratios["rms_10s_m"] for row in rows if "rms_10s_m" in row.ratios]
    limits = [x for r in found for x in (r.low, r.ratio, r.high) if np.isfinite(x)]
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
