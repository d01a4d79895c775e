"""`stario simulate`: a simulated walk as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stario.fusion.commands.common import check_new, print_result
from stario.fusion.commands.options import JsonOption, OverwriteOption, flag
from stario.sequences.errors import InputError


def simulate(
    path: Annotated[Path, typer.Argument(help="CSV file to write.")],
    seconds: Annotated[float, typer.Option(min=1.0, help="Duration in s.")] = 60.0,
    rate: Annotated[float, typer.Option(min=50.0, max=1000.0, help="Sampling rate in Hz.")] = 200.0,
    carry: Annotated[
        str,
        typer.Option(
            help="How the device is carried: handheld, call, swinging, pocket, bag, trolley, rig, "
            "or random, which also draws the person."
        ),
    ] = "random",
    imu: Annotated[str, typer.Option(help="Sensor model: phone, good or perfect.")] = "phone",
    magnetometer: Annotated[
        bool, flag("--magnetometer", help="Also simulate a magnetometer inside a building.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of walk and sensor.")] = 0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a simulated walk with its ground truth as a CSV recording."""
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
    check_choice("--imu", imu, sensors)
    check_choice("--carry", carry, (*CARRYING_MODES, "random"))
    check_amount(seconds, rate)
    style = None if carry == "random" else WalkStyle(carry=carry)
    walk = generate_walk(seed, seconds, style=style)
    field = INDOOR_FIELD if magnetometer else None
    sequence = simulate_imu(walk, rate, sensors[imu], seed, name=path.stem, magnetic_field=field)
    write_csv(path, sequence)
    figures = {
        "path": str(path),
        "duration_s": sequence.duration,
        "path_m": walk.path_length(),
        "samples": len(sequence),
    }
    amount = f"{len(sequence)} samples, {sequence.duration:.1f} s, {walk.path_length():.1f} m"
    print_result(as_json, figures, f"{path}: {amount}")
