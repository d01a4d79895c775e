"""`stario convert` and `simulate`: recordings written to files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from stario.fusion.commands import common, options
from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.errors import InputError, StarioError

if TYPE_CHECKING:
    from stario.sequences.sequence import ImuSequence
    from stario.sequences.simulation.imu import ImuErrors
    from stario.sequences.simulation.walks import WalkStyle


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
    from stario.sequences.datasets.convert import check_content

    outcomes = each(lambda file: check_content(reading.read(file)), files, jobs=1)
    for sequence in without_skipped(outcomes, skipped):
        typer.echo(sequence.summary())
        names.append(sequence.name)
        yield sequence


def simulate(
    context: typer.Context,
    path: Path = typer.Argument(..., help="CSV file to write."),
    seconds: float | None = typer.Option(
        None, min=1.0, help="Duration in s. Default: 60, the clip's, or 180 with --floors."
    ),
    rate: float = typer.Option(200.0, min=50.0, max=1000.0, help="Sampling rate in Hz."),
    carry: str = typer.Option(
        "random",
        help="How the device is carried: handheld, in-front, texting, call, swinging, pocket, "
        "back-pocket, bag, trolley, rig; or random, which draws the person, too, and neither "
        "trolley nor rig. On a body: "
        "front-pocket, back-pocket, belt, jacket, bag, swinging, wrist, ear, head, in-front, "
        "foot, or random.",
    ),
    body: Path | None = typer.Option(
        None,
        help="Motion capture to carry the device: a BVH file, or a clip of an HDF5 file, "
        "FILE.h5:CLIP. Default: a generated walk.",
    ),
    imu: Literal["phone", "good", "perfect"] = typer.Option("phone", help="Sensor model."),
    magnetometer: bool = options.flag(
        False, "--magnetometer", help="Also simulate a magnetometer inside a building."
    ),
    floors: bool = options.flag(
        False,
        "--floors",
        help="Walk from the street through a house with stairs and a lift, with magnetometer, "
        "barometer and satellites.",
    ),
    seed: int = typer.Option(0, min=0, help="Seed of walk and sensor."),
    overwrite: options.Overwrite = False,
    as_json: options.Json = False,
) -> None:
    """Write a simulated walk on a level floor, or a device on motion capture, with its truth."""
    from stario.sequences.readers.csv_writer import write_csv
    from stario.sequences.simulation.house import simulate_house
    from stario.sequences.simulation.imu import GOOD_IMU, PERFECT_IMU, PHONE_IMU, simulate_imu
    from stario.sequences.simulation.magnetometer import INDOOR_FIELD
    from stario.sequences.simulation.walks import check_amount, generate_walk

    if path.suffix.lower() != ".csv":
        fix = "use `stario convert` for other formats and folders"
        raise InputError("path", str(path), "a file name ending in .csv", fix)
    common.check_new("path", path, overwrite)
    errors = {"phone": PHONE_IMU, "good": GOOD_IMU, "perfect": PERFECT_IMU}[imu]
    name, stays = path.stem, []
    if body is not None:
        options.refuse(context, "with --body", "use without", "seconds", "magnetometer", "floors")
        sequence = _on_body(body, carry, rate, errors, seed)
    elif floors:
        options.refuse(context, "with --floors", "use without", "magnetometer")
        house = simulate_house(seed, seconds or 180.0, rate, _style(carry), errors, name=name)
        sequence, stays = house.sequence, house.stays
    else:
        style, field = _style(carry), INDOOR_FIELD if magnetometer else None
        check_amount(seconds or 60.0, rate)
        # Without a barometer stairs are read twice too long: README.md, "Limits".
        walk = generate_walk(seed, seconds or 60.0, style=style, plain=True)
        sequence = simulate_imu(walk, rate, errors, seed, name=name, magnetic_field=field)
    length = 0.0 if sequence.truth is None else sequence.truth.path_length()
    write_csv(path, sequence)
    figures: dict[str, object] = {
        "path": str(path),
        "duration_s": sequence.duration,
        "path_m": length,
        "samples": len(sequence),
    }
    amount = f"{len(sequence)} samples, {sequence.duration:.1f} s, {length:.1f} m"
    if stays:
        figures["stays"] = [asdict(stay) for stay in stays]
        amount += f", floors {', '.join(str(stay.floor) for stay in stays[1:])}"
    common.print_result(as_json, figures, f"{path}: {amount}")


def _style(carry: str) -> WalkStyle | None:
    """Return the typical person who carries the device so; None to draw both."""
    from stario.sequences.arrays import check_choice
    from stario.sequences.simulation.carrying import CARRYING_MODES
    from stario.sequences.simulation.walks import WalkStyle

    check_choice("--carry", carry, (*CARRYING_MODES, "random"))
    return None if carry == "random" else WalkStyle(carry=carry)


def _on_body(body: Path, carry: str, rate: float, errors: ImuErrors, seed: int) -> ImuSequence:
    """Return the recording of a device on a clip of motion capture, at a place drawn if random."""
    from stario.sequences.arrays import generator
    from stario.sequences.simulation.body import places_on, virtual_imu
    from stario.sequences.simulation.motion_capture import read_body

    motion = read_body(body)
    place = str(generator(seed).choice(places_on(motion))) if carry == "random" else carry
    return virtual_imu(motion, place, rate, errors, seed)
