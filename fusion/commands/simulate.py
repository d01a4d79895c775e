"""`stario simulate`: a simulated walk as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stario.fusion.commands.common import check_new, print_result
from stario.fusion.commands.options import JsonOption, OverwriteOption, flag, refuse
from stario.sequences.errors import InputError

if TYPE_CHECKING:
    from stario.sequences.sequence import ImuSequence
    from stario.sequences.simulation.imu import ImuErrors


def simulate(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(help="CSV file to write.")],
    seconds: Annotated[
        float | None, typer.Option(min=1.0, help="Duration in s. Default: 60, or the clip's.")
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
        bool, flag("--magnetometer", help="Also simulate a magnetometer inside a building.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of walk and sensor.")] = 0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a simulated walk, or a device on motion capture, with its truth as a CSV recording."""
    from stario.sequences.arrays import check_choice
    from stario.sequences.readers.csv_writer import write_csv
    from stario.sequences.simulation.imu import GOOD_IMU, PERFECT_IMU, PHONE_IMU, simulate_imu
    from stario.sequences.simulation.magnetometer import INDOOR_FIELD
    from stario.sequences.simulation.walks import (
        CARRYING_MODES,
        WalkStyle,
        check_amount,
        generate_walk,
    )

    if path.suffix.lower() != ".csv":
        fix = "use `stario convert` for other formats and folders"
        raise InputError("path", str(path), "a file name ending in .csv", fix)
    check_new("path", path, overwrite)
    sensors = {"phone": PHONE_IMU, "good": GOOD_IMU, "perfect": PERFECT_IMU}
    errors = sensors[check_choice("--imu", imu, sensors)]
    if body is not None:
        refuse(context, "with --body", "use without", "seconds", "magnetometer")
        sequence = _on_body(body, carry, rate, errors, seed)
    else:
        seconds = 60.0 if seconds is None else seconds
        check_choice("--carry", carry, (*CARRYING_MODES, "random"))
        check_amount(seconds, rate)
        style = None if carry == "random" else WalkStyle(carry=carry)
        field = INDOOR_FIELD if magnetometer else None
        walk = generate_walk(seed, seconds, style=style)
        sequence = simulate_imu(walk, rate, errors, seed, name=path.stem, magnetic_field=field)
    length = 0.0 if sequence.truth is None else sequence.truth.path_length()
    write_csv(path, sequence)
    figures = {
        "path": str(path),
        "duration_s": sequence.duration,
        "path_m": length,
        "samples": len(sequence),
    }
    amount = f"{len(sequence)} samples, {sequence.duration:.1f} s, {length:.1f} m"
    print_result(as_json, figures, f"{path}: {amount}")


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
