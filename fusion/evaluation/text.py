"""Every table of scores as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from stario.sequences.drawing.text_table import aligned, figure

if TYPE_CHECKING:
    import pandas as pd

    from stario.fusion.evaluation.benchmark.groups import Row
    from stario.fusion.evaluation.networks import NetworkTable
    from stario.fusion.evaluation.scores import Column


def rows_of(
    parts: Iterable[tuple[str, pd.DataFrame]], columns: Sequence[Column], corner: str = ""
) -> list[list[str]]:
    """Return the cells of a table, its titles first: a row for each part of the scores."""
    head = [corner, *(column.title for column in columns)]
    return [head, *([name, *(c.text(part) for c in columns)] for name, part in parts)]


def table(
    parts: Iterable[tuple[str, pd.DataFrame]],
    columns: Sequence[Column],
    corner: str = "",
    notes: Sequence[str] = (),
) -> str:
    """Return a table with a row for each part of the scores, and notes below it."""
    return "\n".join([*aligned(rows_of(parts, columns, corner)), *notes])


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


def benchmark_text(rows: Sequence[Row], ours: str, theirs: str | None) -> str:
    """Return for every group rows "theirs" and "ours", then the ratios, the verdict, the words."""
    from stario.fusion.evaluation.benchmark.groups import WORDS, verdict

    named = {"theirs": theirs, "ours": ours} if theirs else {"ours": ours}
    cells = [["", "", "n", "km", *(title for title, _ in _BENCHMARK.values())]]
    for row in rows:
        for label, name in named.items():
            found = [figure(row.medians[name][key], form) for key, (_, form) in _BENCHMARK.items()]
            cells.append([row.name, label, str(row.recordings), f"{row.path_km:.2f}", *found])
    head, *body = aligned(cells)
    lines = [head]
    for k, row in enumerate(rows):
        lines += body[k * len(named) : (k + 1) * len(named)]
        for key, interval in row.ratios.items():
            title = _BENCHMARK[key][0].split(" [")[0]
            lines.append(f"{row.name}: ratio over {title}: {interval:.3f}")
    if conclusion := verdict(rows):
        lines.append(conclusion)
    lines += [f"{label}: {name}" for label, name in reversed(named.items())]
    return "\n".join([*lines, *(f"{key}: {words}." for key, words in WORDS.items())])


def networks_text(table: NetworkTable) -> str:
    """Return a block for each protocol and metric, recordings by networks."""
    from stario.fusion.evaluation.networks import METRICS, PROTOCOLS, table_words

    rows = [*table.scores.groupby("recording", sort=False), ("mean", table.scores)]
    lines = []
    for protocol, words in PROTOCOLS.items():
        for metric, title in METRICS.items():
            columns = [table.column(name, protocol, metric) for name in table.parameters]
            lines += [f"{words}: {title}", *aligned(rows_of(rows, columns)), ""]
    return "\n".join([*lines, *(f"{key}: {words}." for key, words in table_words(table).items())])
