"""Options shared by several commands."""

from __future__ import annotations

import inspect
import json
import math
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stario.sequences.errors import ConfigError, InputError, StarioError

if TYPE_CHECKING:
    from stario.fusion.config import NavigatorConfig
    from stario.network.model import DisplacementModel
    from stario.sequences.datasets.batch import Skipped
    from stario.sequences.sequence import ImuSequence

PathsArgument = Annotated[
    list[Path] | None,
    typer.Argument(metavar="PATH...", help="Recordings, folders or list files."),
]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder for the results.")]
FixesOption = Annotated[
    Path | None,
    typer.Option(
        "--fixes",
        help="CSV of absolute fixes with columns t, kind, x, y, z, sx, sy, sz: position \\[m], "
        "velocity \\[m/s] or yaw \\[rad] (in x), and their sigmas.",
    ),
]
BackendOption = Annotated[str, typer.Option(help="Estimator: ekf or graph.")]
ByOption = Annotated[
    str, typer.Option(help="Group by set, or by an attribute such as person, device or carry.")
]
JobsOption = Annotated[
    int, typer.Option("--jobs", min=1, help="Number of processes that share the recordings.")
]
ReportOption = Annotated[
    bool, typer.Option("--report", help="Also write report.html: map, time slider, plots, health.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the results as JSON on stdout.")]


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading a recording."""

    format: Annotated[
        str, typer.Option("--format", help="Format of the recording: auto or a format name.")
    ] = "auto"
    gyro_unit: Annotated[
        str, typer.Option("--gyro-unit", help="Unit of the gyroscope: rad/s or deg/s.")
    ] = "rad/s"
    accel_unit: Annotated[
        str,
        typer.Option("--accel-unit", help="Unit of the accelerometer: m/s^2, g, -m/s^2 or -g."),
    ] = "m/s^2"
    accel_sign: Annotated[
        str,
        typer.Option(
            "--accel-sign", help="Direction of the accelerometer at rest: up, or apple (down)."
        ),
    ] = "up"
    axes: Annotated[
        str,
        typer.Option(
            "--axes",
            help="Axes of the ground truth in the file's axes, such as y,-x,z (or --axes=-y,x,z).",
        ),
    ] = "x,y,z"
    imu_topic: Annotated[
        str | None, typer.Option("--imu-topic", help="IMU topic of a bag with several IMUs.")
    ] = None
    truth_topic: Annotated[
        str | None, typer.Option("--truth-topic", help="Topic of true poses or odometry in a bag.")
    ] = None
    gravity: Annotated[
        str,
        typer.Option(
            "--gravity",
            help="Gravity in the accelerometer: included, or removed and restored from the true "
            "attitude, or else the device's own.",
        ),
    ] = "included"
    where: Annotated[
        list[str] | None,
        typer.Option(
            "--where",
            help="Only recordings of archives with this attribute, such as person=dan or "
            "'name=r*'. Repeatable: any value of one attribute, but all attributes must match.",
        ),
    ] = None

    def as_read(self) -> dict[str, object]:
        """Return the options that affect a recording's values: all except `where`."""
        return {
            item.name: getattr(self, item.name) for item in fields(self) if item.name != "where"
        }

    def recordings(self, paths: Iterable[Path]) -> tuple[list[Path], list[Skipped]]:
        """Return the recordings at the paths, in folders or list files, and the skipped paths."""
        from stario.sequences.datasets.batch import Skipped
        from stario.sequences.readers import find_recordings

        if self.format != "auto":  # a named format applies to the path itself
            return list(paths), []
        chosen = _attributes(self.where or ())
        files: list[Path] = []
        errors: list[StarioError] = []
        for path in paths:
            try:
                files += find_recordings(path, errors.append, chosen)
            except StarioError as error:
                errors.append(error)
        return files, [Skipped("", str(error)) for error in errors]

    def read(self, path: Path) -> ImuSequence:
        """Read a recording in rad/s, m/s^2 of specific force and the axes of its ground truth."""
        from stario.sequences.conventions import with_conventions
        from stario.sequences.readers import read_recording

        topics = {"imu_topic": self.imu_topic, "truth_topic": self.truth_topic}
        given = {name: topic for name, topic in topics.items() if topic is not None}
        sequence = read_recording(path, self.format, **given)
        return with_conventions(
            sequence, self.gyro_unit, self.accel_unit, self.axes, self.gravity, self.accel_sign
        )


@dataclass(frozen=True)
class EstimatorOptions:
    """Options of the estimator."""

    config: Annotated[
        Path | None, typer.Option("--config", help="TOML or JSON file with settings.")
    ] = None
    model: Annotated[
        str,
        typer.Option(
            "--model",
            help="Weights: default, open, first-stage, walks-36min, or a safetensors or ONNX file.",
        ),
    ] = "default"
    magnetometer: Annotated[
        bool,
        typer.Option(
            "--magnetometer/--no-magnetometer", help="Use the magnetometer, if there is one."
        ),
    ] = True

    declination: Annotated[
        float | None,
        typer.Option(
            "--declination",
            min=-180.0,
            max=180.0,
            help="Magnetic declination in degrees east; the track's y axis then points north.",
        ),
    ] = None

    def settings(self) -> NavigatorConfig:
        """Return the navigator's settings."""
        from stario.fusion.config import NavigatorConfig, read_config

        config = NavigatorConfig() if self.config is None else read_config(self.config)
        chosen = config.filter
        if not self.magnetometer:
            chosen = replace(chosen, magnetometer=False)
        if self.declination is not None:
            chosen = replace(chosen, declination=math.radians(self.declination))
        return replace(config, filter=chosen)

    def network(self) -> DisplacementModel:
        """Load the network with its weights."""
        from stario.network.model import load_model

        return load_model(self.model)

    def network_for(self, jobs: int) -> DisplacementModel | str:
        """Return the loaded network, or for several jobs its name, after checking that it loads."""
        network = self.network()
        return network if jobs == 1 else self.model


def expand_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Expand a command's parameters of an option group into one typer option per field.

    Groups are `ReadingOptions` and `EstimatorOptions`: each option is thus defined only once.
    """
    hints = typing.get_type_hints(command, include_extras=True)
    groups = {
        name: kind for name, kind in hints.items() if kind in (ReadingOptions, EstimatorOptions)
    }
    options: dict[str, inspect.Parameter] = {}
    members: dict[str, list[str]] = {}
    for parameter in inspect.signature(command).parameters.values():
        group = groups.get(parameter.name)
        if group is None:
            options[parameter.name] = parameter.replace(
                annotation=hints[parameter.name], kind=inspect.Parameter.KEYWORD_ONLY
            )
            continue
        kinds = typing.get_type_hints(group, include_extras=True)
        members[parameter.name] = [item.name for item in fields(group)]
        for item in fields(group):
            options[item.name] = inspect.Parameter(
                item.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=item.default,
                annotation=kinds[item.name],
            )

    @wraps(command)
    def flat(**values: Any) -> None:
        grouped = {
            name: groups[name](**{key: values.pop(key) for key in keys})
            for name, keys in members.items()
        }
        command(**values, **grouped)

    flat.__signature__ = inspect.Signature(list(options.values()))  # type: ignore[attr-defined]
    flat.__annotations__ = {name: option.annotation for name, option in options.items()}
    return flat


def recipe_values(path: Path) -> dict[str, Any]:
    """Read the settings of a training recipe from a JSON file.

    Raises:
        ConfigError: the file cannot be read, or is not a table of settings.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(str(path), str(error), "a JSON file with settings") from error
    if not isinstance(values, dict):
        raise ConfigError(str(path), type(values).__name__, "a table of settings")
    return values


def _attributes(words: Iterable[str]) -> dict[str, list[str]]:
    """Return the patterns by attribute from `key=pattern` words."""
    chosen: dict[str, list[str]] = {}
    for word in words:
        key, equals, pattern = word.partition("=")
        if not (key and equals and pattern):
            raise InputError("--where", repr(word), "attribute=value", "such as person=dan")
        chosen.setdefault(key, []).append(pattern)
    return chosen
