"""`stario convert`: recordings to a CSV, the EuRoC layout or an archive."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError, StarioError

if TYPE_CHECKING:
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence


@options.expanded
def convert(
    reading: options.Reading,
    paths: list[Path] = typer.Argument(
        ...,
        metavar="IN... OUT",
        help="Recordings, folders or list files, then the file or new folder to write. "
        "An archive (.h5) takes any number of recordings, the other layouts one.",
    ),
    to: str | None = typer.Option(
        None, help="csv, euroc or archive. Default: by OUT's suffix: .csv, none or .h5."
    ),
    overwrite: options.Overwrite = False,
) -> None:
    """Convert recordings to a CSV, the EuRoC layout or an archive; warn about what they lose."""
    from stario.sequences.datasets.convert import convert as convert_sequence
    from stario.sequences.datasets.convert import layout_of
    from stario.sequences.readers.archive import write_archive

    if len(paths) < 2:
        raise InputError("convert", str(paths[0]), "IN... OUT", "also name the output")
    *sources, target = paths
    layout = layout_of(target, to)
    files, skipped = reading.recordings(sources)
    _check_target(target, [*sources, *files], overwrite)
    if layout != "archive":
        sequence = reading.read(_only(files, skipped))
        written = convert_sequence(sequence, target, to)
        typer.echo(sequence.summary())
        typer.echo("\n".join(f"written: {path}" for path in written))
        return
    read: list[str] = []
    sequences = _read(reading, files, skipped, read)
    try:
        names = write_archive(target, sequences)
    except InputError:
        if not read:  # then nothing was written because each of them was skipped
            common.exit_if_skipped(skipped)
        raise
    for name, stored in zip(read, names, strict=True):
        if stored != name:
            typer.echo(f"{name} is stored as {stored}")
    typer.echo(f"written: {target}, {len(names)} recording{'s' * (len(names) != 1)}")
    common.exit_if_skipped(skipped)


def _check_target(target: Path, sources: list[Path], overwrite: bool) -> None:
    """Refuse to overwrite an input or a part of one, or without `overwrite` anything."""
    from stario.sequences.datasets.convert import EUROC_FILES
    from stario.sequences.readers.archive import split_name

    read = {split_name(source)[0].resolve() for source in sources}
    if target.exists() and read & {target.resolve(), *target.resolve().parents}:
        raise InputError("OUT", f"{target}, which is also an input", "another file")
    common.check_new("OUT", target, overwrite)
    if target.is_dir() and any(target.iterdir()) and not overwrite:
        fix = "or pass --overwrite" if (target / EUROC_FILES[0]).is_file() else ""
        raise InputError("OUT", f"{target}, which already exists", "a new or empty folder", fix)


def _only(files: list[Path], skipped: list[Skipped]) -> Path:
    """Return the only recording found."""
    if len(skipped) == 1 and not files:
        raise StarioError(skipped[0].reason)
    common.exit_if_skipped(skipped)
    if len(files) != 1:
        expected = "one recording, or an archive (.h5) as OUT"
        fix = f"name one, such as {files[0]}" if files else ""
        raise InputError("convert", f"{len(files)} recordings", expected, fix)
    return files[0]


def _read(
    reading: options.Reading, files: list[Path], skipped: list[Skipped], names: list[str]
) -> Iterator[ImuSequence]:
    """Yield each recording and append its name; add those that cannot be used to `skipped`."""
    from stario.sequences.datasets.batch import each, without_skipped
    from stario.sequences.datasets.convert import check_content

    def checked(file: Path) -> ImuSequence:
        return check_content(reading.read(file))

    for sequence in without_skipped(each(checked, files, jobs=1), skipped):
        typer.echo(sequence.summary())
        names.append(sequence.name)
        yield sequence
