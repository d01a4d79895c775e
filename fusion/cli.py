"""The `stario` command: arguments in, library calls, results out.

Heavy packages are imported inside the commands, so that `stario --help` is instant. Exit status: 0
done, 1 a known error in one line on stderr, 2 wrong usage; a bug gives a traceback.
"""

from __future__ import annotations

import itertools
import json
import logging
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stario.sequences.errors import ConfigError, InputError, StarioError

if TYPE_CHECKING:
    from stario.fusion.compare import Comparison
    from stario.fusion.config import NavigatorConfig
    from stario.fusion.navigator import Progress
    from stario.network.model import DisplacementModel
    from stario.network.train import TrainingConfig
    from stario.sequences.sequence import ImuSequence
    from stario.sequences.windows import WorldStream

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Inertial navigation: fused trajectories from IMU recordings.",
)

PathsArgument = Annotated[
    list[Path] | None, typer.Argument(help="Recordings, or folders that hold some.")
]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder for the results.")]
FormatOption = Annotated[
    str, typer.Option("--format", help="Format of the recording: auto, csv, euroc, oxiod.")
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="TOML or JSON file with settings of the filter.")
]
ModelOption = Annotated[
    str, typer.Option("--model", help="Weights: default, or a safetensors file with its card.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as JSON on stdout.")]
GyroUnit = Annotated[str, typer.Option(help="Unit of the gyroscope: rad/s or deg/s.")]
AccelUnit = Annotated[
    str, typer.Option(help="Unit of the accelerometer: m/s^2 or g, or either with a minus.")
]


def main() -> None:
    """Entry point of the `stario` command."""
    logging.basicConfig(level=logging.WARNING, format="stario: %(message)s", stream=sys.stderr)
    try:
        app()
    except StarioError as error:
        typer.echo(f"stario: {error}", err=True)
        sys.exit(1)


@app.command()
def run(
    path: Annotated[Path, typer.Argument(help="A recording: a file, or a recording's folder.")],
    out: OutOption = None,
    format: FormatOption = "auto",
    config: ConfigOption = None,
    model: ModelOption = "default",
    gyro_unit: GyroUnit = "rad/s",
    accel_unit: AccelUnit = "m/s^2",
    as_json: JsonOption = False,
) -> None:
    """Fuse one recording into a track with attitude, velocity, biases and covariance."""
    from stario.fusion.compare import measure
    from stario.fusion.navigator import Navigator
    from stario.fusion.results import write_run
    from stario.sequences.metrics import align

    settings, network = _settings(config), _model(model)
    sequence = _read(path, format, gyro_unit, accel_unit)
    with _progress(f"run {sequence.name}") as progress:
        track = Navigator(network, settings).run(sequence, progress)
    truth = sequence.truth
    metrics = measure(track, truth)
    folder = out or Path("runs") / sequence.name
    aligned = track.trajectory if truth is None else align(track.trajectory, truth, "first")
    written = write_run(folder, sequence.name, track, truth, aligned, metrics, settings)
    if as_json:
        _print_json({"recording": sequence.name, "ekf": metrics, "folder": str(folder)})
        return
    way = f"{sequence.name}: {sequence.duration:.1f} s, {track.trajectory.path_length():.1f} m"
    typer.echo(f"{way} travelled by the estimate")
    if truth is not None:
        typer.echo(_track_table({"ekf": metrics}))
    for line in track.health.lines() if track.health else []:
        typer.echo(line)
    typer.echo(f"{len(written)} files in {folder}")


@app.command()
def compare(
    paths: PathsArgument = None,
    out: OutOption = None,
    format: FormatOption = "auto",
    config: ConfigOption = None,
    model: ModelOption = "default",
    gyro_unit: GyroUnit = "rad/s",
    accel_unit: AccelUnit = "m/s^2",
    as_json: JsonOption = False,
) -> None:
    """Compare tracks: inertial alone, network alone, EKF. Without PATH: a simulated walk."""
    from stario.fusion.compare import compare as compare_tracks
    from stario.fusion.compare import demonstration
    from stario.fusion.results import comparison_dict, write_comparison

    settings, network = _settings(config), _model(model)
    if paths:
        files = _found(paths)
        sequences = _distinct(_read(file, format, gyro_unit, accel_unit) for file in files)
    else:
        typer.echo("demonstration: a simulated walk that training never saw", err=True)
        sequences = [demonstration()]
    comparisons = []
    for sequence in sequences:
        with _progress(f"compare {sequence.name}") as progress:
            comparisons.append(compare_tracks(network, sequence, settings, progress))
    folder = out or Path("runs") / "compare"
    written = write_comparison(folder, comparisons, settings)
    if as_json:
        _print_json(comparison_dict(comparisons))
        return
    for comparison in comparisons:
        _print_comparison(comparison)
    typer.echo(f"{len(written)} files in {folder}")


@app.command()
def evaluate(
    paths: PathsArgument = None,
    data: Annotated[
        Path, typer.Option(help="Folder of the development recordings, used without PATH.")
    ] = Path("../shared/data"),
    split: Annotated[str, typer.Option(help="Which of them: test, validation, training.")] = "test",
    config: ConfigOption = None,
    model: ModelOption = "default",
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Accuracy and consistency over many recordings with truth, medians and means."""
    from stario.fusion.compare import compare as compare_tracks
    from stario.fusion.evaluate import summary, summary_table
    from stario.fusion.results import write_comparison
    from stario.sequences.splits import split_paths

    settings, network = _settings(config), _model(model)
    files = _found(paths) if paths else split_paths(data, split)
    sequences = _distinct(_read(file, "auto", "rad/s", "m/s^2") for file in files)
    comparisons = []
    for sequence in sequences:
        if sequence.truth is None:
            raise InputError(f"{sequence.name}: truth", "none", "a recording with truth")
        with _progress(f"evaluate {sequence.name}") as progress:
            comparisons.append(compare_tracks(network, sequence, settings, progress))
    if out is not None:
        write_comparison(out, comparisons, settings)
    if as_json:
        _print_json(summary(comparisons))
        return
    typer.echo(summary_table(comparisons))


@app.command()
def simulate(
    path: Annotated[Path, typer.Argument(help="CSV file to write.")],
    seconds: Annotated[float, typer.Option(help="Duration in s.")] = 60.0,
    rate: Annotated[float, typer.Option(help="Sampling rate in Hz.")] = 200.0,
    carry: Annotated[
        str, typer.Option(help="How the device is carried; random draws person and carry.")
    ] = "random",
    imu: Annotated[str, typer.Option(help="Sensor: phone, good or perfect.")] = "phone",
    seed: Annotated[int, typer.Option(min=0, help="Of walk and sensor.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Write a simulated walk with its truth as a CSV recording."""
    from stario.sequences.readers.own_csv import write_csv
    from stario.sequences.simulate import GOOD_IMU, PERFECT_IMU, PHONE_IMU, simulate_imu
    from stario.sequences.walks import WalkStyle, generate_walk

    sensors = {"phone": PHONE_IMU, "good": GOOD_IMU, "perfect": PERFECT_IMU}
    if imu not in sensors:
        raise InputError("--imu", repr(imu), f"one of {', '.join(sensors)}")
    style = None if carry == "random" else WalkStyle(carry=carry)
    walk = generate_walk(seed, seconds, style=style)
    sequence = simulate_imu(walk, rate, sensors[imu], seed, name=path.stem)
    write_csv(path, sequence)
    figures = {
        "path": str(path),
        "duration_s": sequence.duration,
        "path_m": walk.path_length(),
        "samples": len(sequence),
    }
    if as_json:
        _print_json(figures)
        return
    typer.echo(
        f"{path}: {figures['samples']} samples, {sequence.duration:.1f} s, "
        f"{walk.path_length():.1f} m"
    )


@app.command()
def train(
    paths: PathsArgument = None,
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run, resumed if it holds a checkpoint.")
    ] = Path("runs/train"),
    validation: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings that choose and calibrate; else the last fifth of each."),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the development recordings: split and walks.")
    ] = None,
    captured: Annotated[
        Path | None, typer.Option(help="Captured trajectories (npz) to drive a simulated IMU.")
    ] = None,
    generated: Annotated[int, typer.Option(min=0, help="Number of generated walks of 60 s.")] = 150,
    config: Annotated[
        Path | None, typer.Option("--config", help="JSON file with settings of the recipe.")
    ] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Epochs, over the file's.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, over the file's.")] = None,
    start_from: Annotated[
        str | None, typer.Option(help="Weights to start from: default, or a safetensors file.")
    ] = None,
    last_stage: Annotated[
        bool,
        typer.Option(
            "--last-stage",
            help="Learn from the validation recordings too, keep the calibration of --start-from.",
        ),
    ] = False,
) -> None:
    """Train a network on recordings with truth and on simulated walks; resumes by itself."""
    from stario.network.data import captured_streams, gather, generated_streams
    from stario.network.train import train as train_network
    from stario.sequences.vicon import read_vicon_walks

    recipe = _recipe(config, epochs=epochs, seed=seed)
    if last_stage and start_from is None:
        raise InputError("--last-stage", "no --start-from", "the weights whose calibration is kept")
    recorded, held_out = _training_recordings(paths or [], validation or [], data)
    walks = captured or (data / "walks/oxiod_vicon.npz" if data else None)
    material = gather(
        recorded + held_out if last_stage else recorded,
        captured_streams(read_vicon_walks(walks), recipe.seed) if walks else [],
        generated_streams(generated, 60.0, recipe.seed),
    )
    held_out = held_out or generated_streams(10, 60.0, recipe.seed + 1)
    for words in material.words:
        typer.echo(words, err=True)
    with _progress("train", total=recipe.steps) as progress:
        path = train_network(
            recipe,
            material.streams,
            material.weights,
            held_out,
            out,
            on_step=lambda step, error: progress(step / recipe.steps),
            on_epoch=lambda report: typer.echo(
                f"epoch {report.epoch}: training {report.training_error:.4f} m^2, "
                f"validation {report.validation_error:.4f} m^2",
                err=True,
            ),
            trained_on=material.words,
            start_from=_model(start_from) if start_from else None,
            keep_calibration=last_stage,
        )
    typer.echo(str(path))


@app.command()
def benchmark(as_json: JsonOption = False) -> None:
    """Speed on this machine: filter against dense algebra, network, whole run."""
    from stario.fusion.speed import speed_report, speed_table

    report = speed_report(_model("default"))
    if as_json:
        _print_json(report)
        return
    typer.echo(speed_table(report))


def _settings(path: Path | None) -> NavigatorConfig:
    from stario.fusion.config import NavigatorConfig, read_config

    return NavigatorConfig() if path is None else read_config(path)


def _model(name: str) -> DisplacementModel:
    from stario.network.model import load_model

    return load_model(name)


def _recipe(path: Path | None, **over: int | None) -> TrainingConfig:
    from stario.network.train import training_config

    values: dict[str, Any] = {}
    if path is not None:
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ConfigError(str(path), str(error), "a JSON file with settings") from error
        if not isinstance(values, dict):
            raise ConfigError(str(path), type(values).__name__, "a table of settings")
    return training_config(values | {k: v for k, v in over.items() if v is not None})


def _read(path: Path, format: str, gyro_unit: str, accel_unit: str) -> ImuSequence:
    from stario.sequences.checks import with_units
    from stario.sequences.readers import read_recording

    return with_units(read_recording(path, format), gyro_unit, accel_unit)


def _found(paths: Iterable[Path]) -> list[Path]:
    from stario.sequences.readers import find_recordings

    return [file for path in paths for file in find_recordings(path)]


def _distinct(sequences: Iterable[ImuSequence]) -> list[ImuSequence]:
    """Recordings under names of their own, since a name is a folder of the results."""
    from dataclasses import replace

    result: dict[str, ImuSequence] = {}
    for sequence in sequences:
        names = (f"{sequence.name}-{k}" if k > 1 else sequence.name for k in itertools.count(1))
        name = next(name for name in names if name not in result)
        result[name] = replace(sequence, name=name)
    return list(result.values())


def _training_recordings(
    paths: list[Path], validation: list[Path], data: Path | None
) -> tuple[list[WorldStream], list[WorldStream]]:
    from stario.network.data import recorded_streams
    from stario.sequences.splits import split_paths

    training_files, validation_files = _found(paths), _found(validation)
    if data is not None:
        training_files += split_paths(data, "training")
        validation_files += split_paths(data, "validation")
    sequences = [_read(p, "auto", "rad/s", "m/s^2") for p in training_files]
    if validation_files or not sequences:
        held_out = [_read(p, "auto", "rad/s", "m/s^2") for p in validation_files]
        return recorded_streams(sequences), recorded_streams(held_out)
    cuts = [s.time[0] + 0.8 * s.duration for s in sequences]
    first = [s.slice(s.time[0], cut) for s, cut in zip(sequences, cuts, strict=True)]
    last = [s.slice(cut, s.time[-1]) for s, cut in zip(sequences, cuts, strict=True)]
    return recorded_streams(first), recorded_streams(last)


@contextmanager
def _progress(title: str, total: int = 100) -> Iterator[Progress]:
    """A bar on stderr, driven by the share of the work done; none where nobody watches."""
    from tqdm import tqdm

    with tqdm(total=total, desc=title, disable=None, leave=False, file=sys.stderr) as bar:

        def advance(share: float) -> None:
            bar.update(max(0, round(share * total) - bar.n))

        yield advance


def _print_comparison(comparison: Comparison) -> None:
    sequence = comparison.sequence
    path = comparison.path_m
    way = "no truth" if path is None else f"{path:.1f} m"
    typer.echo(f"{sequence.name}: {sequence.duration:.1f} s, {way}")
    typer.echo(_track_table(comparison.metrics))


def _track_table(metrics: dict[str, dict[str, float | None]]) -> str:
    columns = {
        "ate_m": "ATE [m]",
        "rte_m": "RTE [m]",
        "pde": "PDE",
        "aye_rad": "AYE [rad]",
        "nees": "NEES",
        "nis": "NIS",
        "seconds_network": "network [s]",
        "seconds_filter": "rest [s]",
    }
    lines = [f"{'':<22}" + "".join(f"{title:>12}" for title in columns.values())]
    for name, figures in metrics.items():
        cells = [figures.get(key) for key in columns]
        lines.append(f"{name:<22}" + "".join(f"{_cell(value):>12}" for value in cells))
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return "-" if value is None or value != value else f"{value:.3f}"


def _print_json(content: object) -> None:
    from stario.sequences.files import json_text

    typer.echo(json_text(content), nl=False)
