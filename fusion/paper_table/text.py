"""The table as Markdown and as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from stario.fusion.evaluation.bootstrap import Rank
from stario.fusion.evaluation.pedestrian import NAME as PDR
from stario.fusion.paper_table.summary import COLUMNS, REFERENCE_NETWORK, Mean, Row, SetTable
from stario.network.architectures import ARCHITECTURES
from stario.network.runtime.survey import BATCHES, ModelRow
from stario.network.training.config import TrainingConfig
from stario.sequences.accuracy.metrics import CONVENTIONS

Work = Mapping[str, tuple[float, float, float]]
"""Result of `stario.fusion.paper_table.summary.seconds_by_network`."""


def table_text(
    tables: Sequence[SetTable], costs: Sequence[ModelRow], work: Work, recipe: TrainingConfig
) -> str:
    """Return the tables of all sets, the costs and the conventions as Markdown.

    The recipe is common to all networks except for its network and seed.
    """
    parts = [_recipe_words(recipe)]
    parts += [_set_text(table) for table in tables]
    parts.append(_cost_text(costs, work))
    parts.append(_words())
    return "\n\n".join(parts) + "\n"


def table_dict(
    tables: Sequence[SetTable], costs: Sequence[ModelRow], work: Work, recipe: TrainingConfig
) -> dict[str, object]:
    """Return the content of `table_text` as plain values."""
    return {
        "recipe": asdict(recipe),
        "sets": {
            table.dataset.name: {
                "split": table.dataset.words,
                "training": len(table.dataset.training),
                "validation": len(table.dataset.validation),
                "tested": table.tested,
                "path_m": table.path_m,
                "ranks_by": table.measure,
                "rows": [asdict(row) for row in table.rows],
                "skipped": table.skipped,
            }
            for table in tables
        },
        "costs": [asdict(row) for row in costs],
        "work": {name: dict(zip(_WORK, times, strict=True)) for name, times in work.items()},
        "conventions": _words(),
    }


_WORK = ("training_s", "evaluation_s", "windows_per_s")


def _recipe_words(recipe: TrainingConfig) -> str:
    return (
        f"All networks: {recipe.steps} training steps of {recipe.batch} windows, peak learning "
        f"rate {recipe.rate:g}, {recipe.precision}, {recipe.attitude} attitude. On sets with weak "
        f"truth, each step also learns from stretches of {recipe.waypoint_seconds} s between "
        f"waypoints ({recipe.waypoint_stretches} per step) and of {recipe.track_seconds} s along "
        f"positions ({recipe.track_stretches} per step)."
    )


def _set_text(table: SetTable) -> str:
    dataset = table.dataset
    lines = [
        f"### {dataset.title}",
        "",
        f"{len(dataset.training)} recordings for training, {len(dataset.validation)} for "
        f"validation, {table.tested} for testing ({table.path_m:.0f} m); {dataset.words}. Ranks "
        f"and ratios are based on the geometric mean over recordings of the {table.measure}.",
        "",
    ]
    keys = [key for key in COLUMNS if any(key in row.figures for row in table.rows)]
    paper = any(published(dataset.name, row.network) for row in table.rows)
    titles = ["network", "seeds", *(COLUMNS[key].title for key in keys)]
    titles += ["rank", f"error / {REFERENCE_NETWORK}'s", "training error", "validation error"]
    titles += ["paper: ATE, RTE [m]"] if paper else []
    rows = [titles]
    for row in table.rows:
        cells = [_title(row, table.tested), str(len(row.seeds))]
        cells += [_cell(row.figures.get(key)) for key in keys]
        cells += [*_rank(row.rank), _cell(row.training_error), _cell(row.validation_error)]
        if paper:
            paper_errors = published(dataset.name, row.network)
            cells.append(
                "" if paper_errors is None else f"{paper_errors[0]:.3f}, {paper_errors[1]:.3f}"
            )
        rows.append(cells)
    lines += _markdown(rows)
    if table.skipped:
        lines += ["", f"Skipped: {len(table.skipped)} recordings, listed in `table.json`."]
    return "\n".join(lines)


def _title(row: Row, tested: int) -> str:
    if row.network == PDR:
        return "pedestrian dead reckoning (`pdr`)"
    if row.network in ARCHITECTURES:
        return row.network
    note = f", trained on {row.learned} of these {tested}" if row.learned else ""
    return f"weights `{row.network}`{note}"


def _rank(rank: Rank | None) -> tuple[str, str]:
    if rank is None:
        return "", ""
    ratio = "" if rank.ratio is None else f"{rank.ratio:.2f}"
    return f"{rank.rank} [{rank.low}, {rank.high}]", ratio


def _cell(mean: Mean | None) -> str:
    if mean is None:
        return ""
    return f"{mean.value:.3f}" if mean.error is None else f"{mean.value:.3f} +- {mean.error:.3f}"


def _cost_text(costs: Sequence[ModelRow], work: Work) -> str:
    times = [f"ms per window, batch {batch}" for batch in BATCHES]
    titles = ["network", "parameters [10^6] (paper)", "FLOPs [10^6] (paper)", "memory [MB]", *times]
    rows = [[*titles, "core hours", "training windows / s"]]
    for row in costs:
        milliseconds = row.milliseconds["torch"] or {}
        training, testing, speed = work.get(row.name, (0.0, 0.0, float("nan")))
        cells = [
            row.name,
            *row.counts(),
            f"{row.peak_memory_mb:.1f}",
            *(f"{milliseconds[str(batch)]:.2f}" for batch in BATCHES),
            f"{(training + testing) / 3600.0:.2f}",
            "" if speed != speed else f"{speed:.0f}",
        ]
        rows.append(cells)
    totals = [sum(times[k] for times in work.values()) / 3600.0 for k in (0, 1)]
    lines = [
        *("### Costs", "", *_markdown(rows), ""),
        f"Total: {sum(totals):.2f} core hours, {totals[0]:.2f} for training and {totals[1]:.2f} "
        "for evaluation. Time per window: on this machine, one thread per core that PyTorch uses; "
        "memory: weights and results of one inference (`stario check models`).",
    ]
    return "\n".join(lines)


def _markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table's lines; the first row holds the titles."""
    head, *body = (f"| {' | '.join(cells)} |" for cells in rows)
    return [head, f"|{'---|' * len(rows[0])}", *body]


def _words() -> str:
    return (
        "ATE, RTE and PDE: horizontal, means over recordings, first poses aligned in yaw and "
        "position; "
        f"{CONVENTIONS['ate_m']}; {CONVENTIONS['rte_m']}; {CONVENTIONS['pde']}. "
        "Squares are also averaged over coordinates, as in RoNIN's code and the paper: multiply by "
        "sqrt(2) for the norm. The first three columns follow the paper's protocol: windows turned "
        "by the true attitude. Waypoints: residual after a fit in yaw and position, in m and in % "
        "of the path, and the length of the track over that of the truth. Positions: error within "
        "stretches of 20 s, each fitted, in % of the path. Training and validation error: mean "
        "squared displacement error of windows [m^2] in the last epoch and in the best one, whose "
        "weights are kept (in validation, legs count in m^2/s). +-: standard error over training "
        "seeds, for one split. Ranks and ratios: equal weights of sets and of the groups (people, "
        "places) in a set. Intervals (95 %): bootstrap over groups, recordings and blocks of 30 s, "
        "with the same draws for all networks; seeds are averaged."
    )


_PUBLISHED = {
    "ronin": (
        (4.165, 8.103, 4.781, 4.755, 4.883, 4.077, 4.629, 4.374, 5.805, 4.471, 3.948),
        (3.724, 4.836, 3.705, 3.736, 3.713, 3.572, 3.681, 3.665, 4.276, 3.572, 3.554),
    ),
    "ridi": (
        (2.080, 3.839, 2.103, 2.486, 2.500, 2.290, 2.379, 2.047, 2.563, 2.118, 2.033),
        (2.383, 3.589, 2.445, 2.644, 2.584, 2.573, 2.406, 2.395, 2.929, 2.446, 2.274),
    ),
    "rnin": (
        (1.844, 3.182, 1.605, 2.174, 3.119, 3.142, 2.648, 2.478, 2.428, 1.250, 1.455),
        (1.836, 3.726, 1.593, 2.114, 1.568, 1.842, 1.613, 1.499, 1.979, 1.213, 1.370),
    ),
    "imunet": (
        (6.428, 8.108, 6.445, 9.130, 6.846, 8.593, 6.479, 6.918, 10.240, 6.577, 4.964),
        (4.802, 6.381, 4.463, 6.404, 4.809, 5.609, 4.458, 5.638, 5.735, 4.601, 3.815),
    ),
    "tlio": (
        (1.333, 2.145, 1.300, 1.354, 1.369, 1.373, 1.724, 1.258, 1.832, 1.254, 1.108),
        (3.705, 3.685, 3.627, 4.060, 0.842, 0.806, 0.959, 0.818, 5.162, 3.525, 3.145),
    ),
    "oxiod": (
        (4.336, 7.282, 2.780, 2.325, 2.381, 2.163, 1.982, 1.696, 3.855, 1.502, 1.484),
        (1.595, 2.301, 1.082, 1.135, 1.142, 1.103, 0.979, 1.100, 1.270, 0.878, 0.856),
    ),
}
"""ATE and RTE [m] published in the paper, by data set, in the order of `ARCHITECTURES`."""


def published(dataset: str, network: str) -> tuple[float, float] | None:
    """Return ATE and RTE [m] from the paper; None if it gives none."""
    if dataset not in _PUBLISHED or network not in ARCHITECTURES:
        return None
    ate, rte = _PUBLISHED[dataset]
    column = list(ARCHITECTURES).index(network)
    return ate[column], rte[column]
