"""Every table of scores as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from stario.fusion.evaluation.compare import FULL_COVERAGE, METRIC_TITLES, Comparison
from stario.sequences.drawing.text_table import aligned, figure

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.evaluation.networks import NetworkTable
    from stario.fusion.evaluation.scores import Column


def rows_of(
    parts: Iterable[tuple[str | tuple[str, ...], pd.DataFrame]],
    columns: Sequence[Column],
    *corner: str,
) -> list[list[str]]:
    """Return the cells of a table, its titles first: a row for each part of the scores.

    Parts are named by one label or by several, whose titles are `corner`.
    """
    rows = [[*corner, *(column.title for column in columns)]]
    for name, part in parts:
        names = (name,) if isinstance(name, str) else name
        rows.append([*names, *(column.text(part) for column in columns)])
    return rows


def table(
    parts: Iterable[tuple[str | tuple[str, ...], pd.DataFrame]],
    columns: Sequence[Column],
    corner: tuple[str, ...] = ("group",),
    notes: Sequence[str] = (),
) -> str:
    """Return a table with a row for each part of the scores, and notes below it."""
    return "\n".join([*aligned(rows_of(parts, columns, *corner)), *notes])


_BENCHMARK = {
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
    from stario.fusion.evaluation.benchmark.groups import RATIOS, WORDS, verdict
    from stario.fusion.evaluation.bootstrap import Interval

    cells = [["", "", "n", "km", *(title for title, _ in _BENCHMARK.values())]]
    for row in rows.to_dict("records"):
        known = [row["group"], row["role"], str(row["recordings"])]
        found = [figure(row[key], form) for key, (_, form) in _BENCHMARK.items()]
        cells.append([*known, f"{row['path_km']:.2f}", *found])
    head, *body = aligned(cells)
    lines = [head]
    for line, row in zip(body, rows.to_dict("records"), strict=True):
        lines.append(line)
        for key, metric in RATIOS.items():
            if isinstance(row[key], Interval):
                title = _BENCHMARK[metric][0].split(" [")[0]
                lines.append(f"{row['group']}: ratio over {title}: {row[key]:.3f}")
    if conclusion := verdict(rows):
        lines.append(conclusion)
    lines += [f"ours: {ours}", *([f"theirs: {theirs}"] if theirs else [])]
    return "\n".join([*lines, *(f"{key}: {words}." for key, words in WORDS.items())])


def networks_text(table: NetworkTable) -> str:
    """Return a block for each protocol and metric, recordings by networks."""
    from stario.fusion.evaluation.networks import METRICS, PROTOCOLS, table_words

    rows = [*table.scores.groupby("recording", sort=False), ("mean", table.scores)]
    lines = []
    for protocol, words in PROTOCOLS.items():
        for metric, title in METRICS.items():
            columns = [table.column(name, protocol, metric) for name in table.parameters]
            lines += [f"{words}: {title}", *aligned(rows_of(rows, columns, "")), ""]
    return "\n".join([*lines, *(f"{key}: {words}." for key, words in table_words(table).items())])


_UNTRACKED = 1.5
"""Time at a recording's ends without a track [s] below which all of it counts as tracked: a track
starts where the attitude is known, up to a second after the first sample."""

_EXPLAINED = (
    *("ate_m", "horizontal", "alignment", "ate_fit_m", "rte_m", "pde", "aye_rad"),
    *("nees_median", "nis_mean", "seconds_filter"),
)
"""Figures explained below a table, or below several."""


def track_table(found: Comparison) -> str:
    """Format a table with a row of known metrics per track; `column_words` explains it."""
    metrics, truth, columns = found.metrics, found.sequence.truth, _known_columns(found)
    rows = [
        [name, *(figure(values.get(key)) for key in columns)] for name, values in metrics.items()
    ]
    lines = aligned([["", *columns.values()], *rows])
    if truth is None:
        return "\n".join(lines)
    covered = float(truth.covers(found.tracks[found.main].time).mean())
    if covered < FULL_COVERAGE:
        lines.append(f"The truth covers {covered:.0%} of the track; metrics refer to that part.")
    return "\n".join(lines)


def column_words(found: Comparison) -> dict[str, str]:
    """Return the meaning of the columns of a table by their titles without units."""
    titles, words = _known_columns(found), found.words
    if found.sequence.truth is not None:
        titles |= {"horizontal": "horizontal", "alignment": "alignment"}
    return {titles[key].partition(" [")[0]: words[key] for key in _EXPLAINED if key in titles}


def _known_columns(found: Comparison) -> dict[str, str]:
    """Return the titles of the figures that are known of any track."""
    known = {
        key
        for values in found.metrics.values()
        for key, value in values.items()
        if value is not None
    }
    return {key: title for key, title in METRIC_TITLES.items() if key in known}


def tracked_words(found: Comparison) -> str:
    """Return how much of a recording is tracked: less where a sensor stopped, for example."""
    time = found.tracks[found.main].time
    recorded, tracked = found.sequence.duration, float(time[-1] - time[0])
    if recorded - tracked < _UNTRACKED:
        return f"{recorded:.1f} s"
    return f"{tracked:.1f} of {recorded:.1f} s tracked"
