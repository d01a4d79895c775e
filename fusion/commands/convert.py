"""`stario convert`: recordings to a CSV, the EuRoC layout or an archive."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import check_new, collect_results, exit_if_skipped
from stario.fusion.commands.options import OverwriteOption, ReadingOptions, expand_option_groups
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence


@expand_option_groups
def convert(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="IN... OUT",
            help="Recordings, folders or list files, then the file or new folder to write. "
            "An archive (.h5) takes any number of recordings, the other layouts one.",
        ),
    ],
    reading: ReadingOptions,
    to: Annotated[
        str | None,
        typer.Option(help="csv, euroc or archive. Default: by OUT's suffix: .csv, none or .h5."),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Convert recordings to a CSV, the EuRoC layout or an archive; warn about what they lose."""
    from stario.sequences.datasets.convert import convert as convert_sequence
    from stario.sequences.datasets.convert import convert_all, layout_of

    if len(paths) < 2:
        raise InputError("convert", str(paths[0]), "IN... OUT", "also name the output")
    *sources, target = paths
    layout = layout_of(target, to)
    files, skipped = reading.recordings(sources)
    _check_target(target, [*sources, *files], overwrite)
    if layout != "archive":
        only = sources[0] if len(sources) == 1 and not reading.where else _only(files, skipped)
        sequence = reading.read(only)
        written = convert_sequence(sequence, target, to)
        typer.echo(f"{sequence.name}: {len(sequence)} samples, {sequence.duration:.1f} s")
        typer.echo("\n".join(str(path) for path in written))
        return
    names = convert_all(_read(reading, files, skipped), target)
    typer.echo(f"{len(names)} recording{'s' * (len(names) != 1)} in {target}")
    exit_if_skipped(skipped)


def _check_target(target: Path, sources: list[Path], overwrite: bool) -> None:
    """Refuse to overwrite an input, or without `overwrite` any existing file."""
    from stario.sequences.readers.archive import split_name

    read = {split_name(source)[0] for source in sources}
    if target.exists() and any(file.exists() and target.samefile(file) for file in read):
        raise InputError("OUT", f"{target}, which is also an input", "another file")
    check_new("OUT", target, overwrite)


def _only(files: list[Path], skipped: list[Skipped]) -> Path:
    """Return the only recording found."""
    exit_if_skipped(skipped)
    if len(files) != 1:
        expected = "one recording, or an archive (.h5) as OUT"
        raise InputError("convert", f"{len(files)} recordings", expected)
    return files[0]


def _read(
    reading: ReadingOptions, files: list[Path], skipped: list[Skipped]
) -> Iterator[ImuSequence]:
    """Yield one recording after the other; add those that cannot be converted to `skipped`."""
    from stario.sequences.datasets.batch import each
    from stario.sequences.datasets.convert import check_content

    def checked(file: Path) -> ImuSequence:
        sequence = reading.read(file)
        check_content(sequence)
        return sequence

    for sequence in collect_results(each(checked, files, jobs=1), skipped):
        typer.echo(f"{sequence.name}: {len(sequence)} samples, {sequence.duration:.1f} s")
        yield sequence
