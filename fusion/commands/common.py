"""Shared parts of the commands: iteration over recordings, progress, tables and JSON."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import typer

from stario.fusion.commands.options import ReadingOptions
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.fusion.recording import Progress
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

Result = TypeVar("Result")


def collect_results(
    outcomes: Iterable[Result | Skipped],
    skipped: list[Skipped],
    progress: Callable[[int], None] = lambda done: None,
) -> list[Result]:
    """Return the results in order; append recordings that could not be used to `skipped`.

    Args:
        outcomes: results and failures from `stario.sequences.datasets.batch.each`.
        skipped: list to extend.
        progress: called with the number of recordings finished so far.
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


def map_recordings(
    title: str,
    reading: ReadingOptions,
    paths: Sequence[Path],
    work: Callable[[Path, ImuSequence], Result],
) -> tuple[list[Result], list[Skipped]]:
    """Apply `work` to each recording with a progress bar; return results and failures.

    Args:
        title: label of the progress bar.
        reading: options for reading recordings.
        paths: recordings, folders or list files.
        work: function of a recording's path and the recording.
    """
    from stario.sequences.datasets.batch import each

    files, skipped = reading.recordings(paths)

    def done_with(file: Path) -> Result:
        return work(file, reading.read(file))

    with progress_bar(title, len(files)) as progress:
        outcomes = each(done_with, files, jobs=1)
        found = collect_results(outcomes, skipped, lambda done: progress(done / len(files)))
    return found, skipped


def process_each(
    reading: ReadingOptions,
    paths: Sequence[Path],
    out: Path | None,
    work: Callable[[ImuSequence, Path], dict[str, object]],
    as_json: bool,
    single: str = "",
) -> None:
    """Apply `work` to each recording, giving each its own folder for files.

    Args:
        reading: options for reading recordings.
        paths: recordings, folders or list files.
        out: folder of a single recording, or parent folder of several; None for `runs`/NAME.
        work: function of a recording and its folder, distinct for each; returns its record.
        as_json: whether to print the records.
        single: name of an option in use that allows only one recording; empty if none.
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

    records = collect_results(each(recorded, files, jobs=1), skipped)
    if as_json and records:
        print_json(records[0] if len(files) == 1 else records)
    exit_if_skipped(skipped)


def exit_if_skipped(skipped: Sequence[Skipped]) -> None:
    """List what was skipped on stderr and exit with status 1 if there was any."""
    for failure in skipped:
        where = "" if failure.item in failure.reason else f"{failure.item}: "
        typer.echo(f"stario: skipped: {where}{failure.reason}", err=True)
    if skipped:
        raise typer.Exit(1)


@contextmanager
def progress_bar(title: str, total: int = 100, shown: bool = True) -> Iterator[Progress]:
    """Show a progress bar on stderr, driven by the completed share; hidden without a terminal."""
    from tqdm import tqdm

    hidden = None if shown else True
    with tqdm(total=total, desc=title, disable=hidden, leave=False, file=sys.stderr) as bar:

        def advance(share: float) -> None:
            bar.update(max(0, round(share * total) - bar.n))

        yield advance


_FULL_COVERAGE = 0.98
"""Share of a track below which the coverage by ground truth is reported as partial."""


_EXPLAINED = ("ate_m", "alignment", "ate_fit_m", "rte_m", "pde", "aye_rad", "nees", "nis")
"""Metrics explained below a table."""


def track_table(
    metrics: dict[str, dict[str, float | None]],
    time: FloatArray,
    truth: Trajectory | None,
    words: dict[str, str],
) -> str:
    """Format a table with a row of metrics per track, and their meaning if there is truth.

    Args:
        metrics: metrics by track.
        time: (N,) times of a track [s].
        truth: ground truth, or None.
        words: meaning of each metric.
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
        "seconds_filter": "other [s]",
    }
    rows = [
        [name, *(figure(values.get(key)) for key in columns)] for name, values in metrics.items()
    ]
    lines = aligned([["", *columns.values()], *rows])
    if truth is None:
        return "\n".join(lines)
    lines += [f"{key}: {words[key]}." for key in _EXPLAINED]
    covered = float(truth.covers(time).mean())
    if covered < _FULL_COVERAGE:
        lines.append(f"The truth covers {covered:.0%} of the track; metrics refer to that part.")
    return "\n".join(lines)


def print_json(content: object) -> None:
    """Print JSON on stdout."""
    from stario.sequences.files import json_text

    typer.echo(json_text(content), nl=False)
