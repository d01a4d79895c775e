"""Shared parts of the commands: iteration over recordings, what they skip, progress, files."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, TypeVar

import typer

from stario.fusion.commands import options
from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.errors import InputError
from stario.sequences.lazy import optional_package

if TYPE_CHECKING:
    from stario.fusion.evaluation.results import Writers
    from stario.fusion.recording import Progress
    from stario.network.model import DisplacementModel
    from stario.sequences.sequence import ImuSequence

Result = TypeVar("Result")

_LINE_SECONDS = 10.0
"""Time between lines of progress [s] where there is no terminal for a bar."""

_NAMED = 3
"""Number of skipped recordings with the same reason that are listed one by one."""


def each_used(
    title: str, work: Callable[[Path], Result], files: Collection[Path], jobs: int = 1
) -> tuple[list[Result], list[Skipped]]:
    """Apply `work` to each file, with a bar if titled; return the results, and what was skipped."""
    skipped: list[Skipped] = []
    outcomes = with_bar(title, each(work, files, jobs), len(files))
    return list(without_skipped(outcomes, skipped)), skipped


def map_recordings(
    title: str,
    reading: options.Reading,
    files: Collection[Path],
    work: Callable[[Path, ImuSequence], Result],
) -> tuple[list[Result], list[Skipped]]:
    """Do as `each_used` with each file and its recording, which has a name of its own."""
    from stario.fusion.evaluation.compare import distinct_name

    names: set[str] = set()

    def read(file: Path) -> Result:
        sequence = reading.read(file)
        return work(file, replace(sequence, name=distinct_name(sequence.name, names)))

    return each_used(title, read, files)


def process_each(
    reading: options.Reading,
    paths: Sequence[Path],
    out: Path | None,
    work: Callable[[ImuSequence, Path], tuple[dict[str, object], str]],
    as_json: bool,
    single: str = "",
) -> None:
    """Apply `work` to each recording and a folder of its own; print the records or the texts.

    The folder is `out` for a single recording, else within it; None for `runs`/NAME. An option that
    allows only one recording is named by `single`.
    """
    from stario.sequences.files import check_folder

    files, skipped = reading.recordings(paths)
    if single and len(files) > 1:
        raise InputError(single, f"{len(files)} recordings", "one recording")
    if out is not None:
        check_folder(out)

    def recorded(file: Path, sequence: ImuSequence) -> dict[str, object]:
        folder = out if out and len(files) == 1 else (out or Path("runs")) / sequence.name
        record, text = work(sequence, folder)
        if not as_json:
            typer.echo(text)
        return record

    records, failed = map_recordings("", reading, files, recorded)
    if as_json and records:
        print_result(True, records[0] if len(files) == 1 else records)
    exit_if_skipped(skipped + failed)


def further_files(report: bool, tiles: str = "", view: bool = False) -> Writers:
    """Return what writes the report and the viewer's file, if their packages are there."""
    also: dict[str, Callable[..., object]] = {}
    if report:
        optional_package("plotly", "report")
        from stario.fusion.report.page import write_report

        also["report.html"] = partial(write_report, tiles=tiles)
    if tiles:
        if not report:
            raise InputError("--tiles", "use without --report", "use with it")
        from stario.fusion.report.background import check_tiles

        check_tiles(tiles)
    if view:
        optional_package("rerun", "view")
        from stario.fusion.report.view import write_view

        also["track.rrd"] = write_view
    return also


def explain(as_json: bool) -> None:
    """Print what the words of `run` and `compare` mean; on stderr if stdout is JSON."""
    from stario.fusion.evaluation.text import EXPLANATION

    typer.echo(EXPLANATION, err=as_json)


def check_new(field: str, path: Path, overwrite: bool) -> None:
    """Refuse a path whose file would be replaced, unless `overwrite` is given."""
    if path.is_file() and not overwrite:
        found = f"{path}, which already exists"
        raise InputError(field, found, "a new file", "or pass --overwrite")


def list_skipped(skipped: Sequence[Skipped]) -> None:
    """List what was skipped on stderr; many recordings with one reason take one line."""
    by_reason: dict[str, list[str]] = {}
    for failure in skipped:
        by_reason.setdefault(_bare_reason(failure), []).append(failure.item)
    for reason, items in by_reason.items():
        several = [f"{len(items)} recordings, the first {items[0]}"]
        for words in items if len(items) <= _NAMED else several:
            where = "" if words in reason else f"{words}: "
            typer.echo(f"stario: skipped: {where}{reason}", err=True)


def _bare_reason(failure: Skipped) -> str:
    """Return the reason without the recording's name, by which messages begin."""
    from stario.sequences.readers.archive import split_name

    path = Path(failure.item)
    member = split_name(path)[1]
    reason = failure.reason.removeprefix(f"{failure.item}: ")
    return reason.removeprefix(f"{member or path.stem}: ")


def exit_if_skipped(skipped: Sequence[Skipped]) -> None:
    """List what was skipped on stderr and exit with status 1 if there was any."""
    list_skipped(skipped)
    if skipped:
        raise typer.Exit(1)


def with_bar(title: str, items: Iterable[Result], total: int) -> Iterable[Result]:
    """Yield the items with a progress bar on stderr; hidden without a terminal or a title."""
    from tqdm import tqdm

    hidden = None if title else True
    shown: Iterable[Result] = tqdm(items, title, total, leave=False, disable=hidden)
    return shown


@contextmanager
def progress_bar(title: str, total: int = 100, shown: bool = True) -> Iterator[Progress]:
    """Show a progress bar on stderr, driven by the completed share; hidden without a terminal."""
    from tqdm import tqdm

    hidden = None if shown else True
    with tqdm(total=total, desc=title, disable=hidden, leave=False, file=sys.stderr) as bar:

        def advance(share: float) -> None:
            bar.update(max(0, round(share * total) - bar.n))

        yield advance


@contextmanager
def training_progress(steps: int, shown: bool = True) -> Iterator[Callable[[int, float], None]]:
    """Show the progress of a training on stderr: a bar, and without a terminal a line at times.

    The function that is yielded takes the step and its mean squared error [m^2].
    """
    from tqdm import tqdm

    told = monotonic()
    with progress_bar("train", steps, shown) as bar:
        first, began = 0, told

        def advance(step: int, error: float) -> None:
            nonlocal told, first, began
            bar(step / steps)
            now = monotonic()
            if not first:  # of a resumed run another than 1
                first, began = step, now
            if not shown or sys.stderr.isatty() or step == first or now - told < _LINE_SECONDS:
                return
            told = now
            left = (steps - step) * (now - began) / max(step - first, 1)
            words = f"step {step} of {steps}, about {tqdm.format_interval(left)} left"
            typer.echo(f"{words}, error {error:.4f} m^2", err=True)

        yield advance


def print_result(as_json: bool, record: object, text: str = "") -> None:
    """Print a result on stdout: its record as JSON, or else its text."""
    from stario.sequences.files import json_text

    typer.echo(json_text(record) if as_json else text, nl=not as_json)


def origin_of(
    paths: Sequence[Path],
    reading: options.Reading,
    estimating: options.Estimator,
    network: DisplacementModel,
    fixes: Path | None = None,
) -> dict[str, object]:
    """Return the content of `run.json`: what was read, by which network and with which fixes."""
    from importlib.metadata import version

    return {
        "stario": version("stario-nav"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "model": estimating.model,
        "weights_sha256": network.card.sha256 or None,
        "inputs": [str(path.absolute()) for path in paths],
        "reading": reading.changed(),
        "fixes": fixes and str(fixes.absolute()),
    }


def training_command(paths: Sequence[Path], reading: options.Reading, model: str) -> str:
    """Return the command that goes on training a model's weights on recordings, read alike."""
    options = [
        f"--{name.replace('_', '-')}={each}"
        for name, value in reading.changed().items()
        for each in (value if isinstance(value, list) else [value])
    ]
    start = "default" if Path(model).suffix == ".onnx" else model
    words = ["stario", "train", *map(str, paths), *options, "--start-from", start]
    return shlex.join(words)


def names_in(text: str) -> list[str]:
    """Return the names in a comma-separated list."""
    return [name.strip() for name in text.split(",")]
