"""`stario simulate`: a simulated walk as a recording."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands import common, options
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.sequences.sequence import ImuSequence
    from stario.sequences.simulation.house import HouseWalk
    from stario.sequences.simulation.imu import ImuErrors
    from stario.sequences.simulation.walks import WalkStyle


def simulate(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(help="CSV file to write.")],
    seconds: Annotated[
        float | None,
        typer.Option(min=1.0, help="Duration in s. Default: 60, the clip's, or 180 with --floors."),
    ] = None,
    rate: Annotated[float, typer.Option(min=50.0, max=1000.0, help="Sampling rate in Hz.")] = 200.0,
    carry: Annotated[
        str,
        typer.Option(
            help="How the device is carried: handheld, in-front, texting, call, swinging, pocket, "
            "back-pocket, bag, trolley, rig, or random, which also draws the person. On a body: "
            "front-pocket, back-pocket, belt, jacket, bag, swinging, wrist, ear, head, in-front, "
            "foot, or random."
        ),
    ] = "random",
    body: Annotated[
        Path | None,
        typer.Option(
            help="Motion capture to carry the device: a BVH file, or a clip of an HDF5 file, "
            "FILE.h5:CLIP. Default: a generated walk."
        ),
    ] = None,
    imu: Annotated[str, typer.Option(help="Sensor model: phone, good or perfect.")] = "phone",
    magnetometer: Annotated[
        bool, options.flag("--magnetometer", help="Also simulate a magnetometer inside a building.")
    ] = False,
    floors: Annotated[
        bool,
        options.flag(
            "--floors",
            help="Walk from the street through a house with stairs and a lift, with magnetometer, "
            "barometer and satellites.",
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of walk and sensor.")] = 0,
    overwrite: options.Overwrite = False,
    as_json: options.Json = False,
) -> None:
    """Write a simulated walk, or a device on motion capture, with its truth as a CSV recording."""
    from stario.sequences.arrays import check_choice
    from stario.sequences.readers.csv_writer import write_csv
    from stario.sequences.simulation.imu import GOOD_IMU, PERFECT_IMU, PHONE_IMU

    if path.suffix.lower() != ".csv":
        fix = "use `stario convert` for other formats and folders"
        raise InputError("path", str(path), "a file name ending in .csv", fix)
    common.check_new("path", path, overwrite)
    sensors = {"phone": PHONE_IMU, "good": GOOD_IMU, "perfect": PERFECT_IMU}
    errors = sensors[check_choice("--imu", imu, sensors)]
    stays = []
    if body is not None:
        options.refuse(context, "with --body", "use without", "seconds", "magnetometer", "floors")
        sequence = _on_body(body, carry, rate, errors, seed)
    elif floors:
        options.refuse(context, "with --floors", "use without", "magnetometer")
        walk = _through_house(path.stem, carry, seconds, rate, errors, seed)
        sequence, stays = walk.sequence, walk.stays
    else:
        sequence = _walk(path.stem, carry, seconds, magnetometer, rate, errors, seed)
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


def _walk(
    name: str,
    carry: str,
    seconds: float | None,
    magnetometer: bool,
    rate: float,
    errors: ImuErrors,
    seed: int,
) -> ImuSequence:
    from stario.sequences.simulation.imu import simulate_imu
    from stario.sequences.simulation.magnetometer import INDOOR_FIELD
    from stario.sequences.simulation.walks import check_amount, generate_walk

    style = _style(carry)
    seconds = 60.0 if seconds is None else seconds
    check_amount(seconds, rate)
    field = INDOOR_FIELD if magnetometer else None
    walk = generate_walk(seed, seconds, style=style)
    return simulate_imu(walk, rate, errors, seed, name=name, magnetic_field=field)


def _through_house(
    name: str, carry: str, seconds: float | None, rate: float, errors: ImuErrors, seed: int
) -> HouseWalk:
    from stario.sequences.simulation.house import simulate_house

    style = _style(carry)
    seconds = 180.0 if seconds is None else seconds
    return simulate_house(seed, seconds, rate, style, errors, name=name)


def _style(carry: str) -> WalkStyle | None:
    """Return the typical person who carries the device so; None to draw both."""
    from stario.sequences.arrays import check_choice
    from stario.sequences.simulation.walks import CARRYING_MODES, WalkStyle

    check_choice("--carry", carry, (*CARRYING_MODES, "random"))
    return None if carry == "random" else WalkStyle(carry=carry)


def _on_body(
    body: Path,
    carry: str,
    rate: float,
    errors: ImuErrors,
    seed: int,
) -> ImuSequence:
    """Return the recording of a device on a clip of motion capture, at a place drawn if random."""
    from stario.sequences.arrays import generator
    from stario.sequences.simulation.body import places_on, virtual_imu
    from stario.sequences.simulation.motion_capture import read_body

    motion = read_body(body)
    place = str(generator(seed).choice(places_on(motion))) if carry == "random" else carry
    return virtual_imu(motion, place, rate, errors, seed)
