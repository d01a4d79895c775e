"""What the commands share: the way through recordings, progress, tables and JSON."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import typer

from stario.fusion.commands.options import Reading
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.recording import Progress
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

Result = TypeVar("Result")


def collected(
    outcomes: Iterable[Result | Skipped],
    skipped: list[Skipped],
    progress: Callable[[int], None] = lambda done: None,
) -> list[Result]:
    """What came of recordings, in order; those that could not be used join `skipped`.

    Args:
        outcomes: as `stario.sequences.datasets.batch.each` yields them.
        skipped: takes them up.
        progress: called with the number of recordings that are done.
    """
    from stario.sequences.datasets.batch import Skipped

    results: list[Result] = []
    for done, outcome in enumerate(outcomes, 1):
        if isinstance(outcome, Skipped):
            skipped.append(outcome)
        else:
            results.append(outcome)
        progress(done)
    return results


def result_of_each(
    title: str,
    reading: Reading,
    paths: Sequence[Path],
    work: Callable[[Path, ImuSequence], Result],
) -> tuple[list[Result], list[Skipped]]:
    """What `work` makes of each recording, behind a progress bar, and what could not be used.

    Args:
        title: of the bar.
        reading: how recordings are read.
        paths: of recordings, folders or lists.
        work: given a recording's path and the recording.
    """
    from stario.sequences.datasets.batch import each

    files, skipped = reading.recordings(paths)

    def done_with(file: Path) -> Result:
        return work(file, reading.read(file))

    with progress_bar(title, len(files)) as progress:
        outcomes = each(done_with, files, jobs=1)
        found = collected(outcomes, skipped, lambda done: progress(done / len(files)))
    return found, skipped


def one_by_one(
    reading: Reading,
    paths: Sequence[Path],
    out: Path | None,
    work: Callable[[ImuSequence, Path], dict[str, object]],
    as_json: bool,
    single: str = "",
) -> None:
    """Let `work` make a record of each recording, and a folder where it leaves its files.

    Args:
        reading: how recordings are read.
        paths: of recordings, folders or lists.
        out: the folder of a single recording, or of the folders of many; None for `runs`.
        work: given a recording and its folder; more than one recording have distinct names.
        as_json: print the records.
        single: an option that was given and goes with one recording alone.
    """
    from stario.fusion.evaluation.many import distinct_name
    from stario.sequences.datasets.batch import each

    files, skipped = reading.recordings(paths)
    if single and len(files) > 1:
        raise InputError(single, f"{len(files)} recordings", "one recording")
    names: set[str] = set()

    def recorded(file: Path) -> dict[str, object]:
        sequence = reading.read(file)
        name = distinct_name(sequence.name, names)
        return work(sequence, out if out and len(files) == 1 else (out or Path("runs")) / name)

    records = collected(each(recorded, files, jobs=1), skipped)
    if as_json and records:
        print_json(records[0] if len(files) == 1 else records)
    leave_with_skipped(skipped)


def leave_with_skipped(skipped: Sequence[Skipped]) -> None:
    """Name on stderr what could not be used, and leave with 1 if there was any."""
    for one in skipped:
        where = "" if one.item in one.reason else f"{one.item}: "
        typer.echo(f"stario: skipped: {where}{one.reason}", err=True)
    if skipped:
        raise typer.Exit(1)


@contextmanager
def progress_bar(title: str, total: int = 100, shown: bool = True) -> Iterator[Progress]:
    """A bar on stderr, driven by the share of the work done; none where nobody watches."""
    from tqdm import tqdm

    hidden = None if shown else True
    with tqdm(total=total, desc=title, disable=hidden, leave=False, file=sys.stderr) as bar:

        def advance(share: float) -> None:
            bar.update(max(0, round(share * total) - bar.n))

        yield advance


_WHOLE = 0.98
"""A track of which the truth covers less is said to be compared in part."""


_EXPLAINED = ("ate_m", "alignment", "ate_fit_m", "rte_m", "pde", "aye_rad", "nees", "nis")
"""Figures whose meaning stands below a table."""


def track_table(
    metrics: dict[str, dict[str, float | None]],
    time: FloatArray,
    truth: Trajectory | None,
    words: dict[str, str],
) -> str:
    """A row of figures for each track, and what they mean where there is truth.

    Args:
        metrics: by track.
        time: (N,) of a track [s].
        truth: None where there is none.
        words: what the figures mean.
    """
    columns = {
        "ate_m": "ATE [m]",
        "ate_fit_m": "fitted [m]",
        "rte_m": "RTE [m]",
        "pde": "PDE",
        "aye_rad": "AYE [rad]",
        "nees": "NEES",
        "nis": "NIS",
        "seconds_network": "network [s]",
        "seconds_filter": "rest [s]",
    }
    rows = [[name, *(figure(found.get(key)) for key in columns)] for name, found in metrics.items()]
    lines = aligned([["", *columns.values()], *rows])
    if truth is None:
        return "\n".join(lines)
    lines += [f"{key}: {words[key]}." for key in _EXPLAINED]
    covered = float(truth.covers(time).mean())
    if covered < _WHOLE:
        lines.append(f"The truth covers {covered:.0%} of the track: figures are of that part.")
    return "\n".join(lines)


def print_json(content: object) -> None:
    """Print figures on stdout for another program."""
    from stario.sequences.files import json_text

    typer.echo(json_text(content), nl=False)
