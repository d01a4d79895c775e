"""Results of judging by groups as text, CSV, JSON and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from stario.fusion.evaluation.judging.bootstrap import CONFIDENCE, REPLICATES, Interval
from stario.fusion.evaluation.judging.displacement_error import FIGURES
from stario.fusion.evaluation.judging.figure import groups_figure
from stario.fusion.evaluation.judging.judge import RecordingResult, Row
from stario.sequences.drawing.figures import save_figure
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.files import write_json, write_rows

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
            lines.append(f"{row.name}: ratio over {title}: {_interval(interval)}")
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
        return (
            f"not decided, {len(ratios)} groups are too few: pooled {_interval(pooled)} over 10 s"
        )
    words = f"pooled {_interval(pooled)} over 10 s, worst {worst} {_interval(ratios[worst])}"
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
    """Write `groups.csv`, `recordings.csv`, `groups.json` and `groups.png` into a folder."""
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


def _interval(found: Interval) -> str:
    return f"{found.ratio:.3f} [{found.low:.3f}, {found.high:.3f}]"
