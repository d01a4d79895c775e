"""Options shared by several commands."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stario.sequences.datasets.batch import Skipped, skipped
from stario.sequences.errors import InputError, StarioError

if TYPE_CHECKING:
    from stario.fusion.values.config import NavigatorConfig
    from stario.network.model import DisplacementModel
    from stario.sequences.sequence import ImuSequence

_reading = partial(typer.Option, rich_help_panel="Reading")
_place = partial(typer.Option, rich_help_panel="Place")
_estimation = partial(typer.Option, rich_help_panel="Estimation")
flag = partial(typer.Option, metavar="")
"""Option without a value; the help would show `<bool>` after it."""

_PATHS = typer.Argument(metavar="PATH...", help="Recordings, folders or list files.")
Paths = Annotated[list[Path], _PATHS]
OptionalPaths = Annotated[list[Path] | None, _PATHS]
Cache = Annotated[
    Path | None,
    typer.Option(help="Folder for cached windows. Default: STARIO_CACHE or ~/.cache/stario."),
]
Data = Annotated[
    Path | None, typer.Option(help="Folder of the development recordings, used without PATH.")
]
Config = Annotated[
    Path | None,
    _estimation(help="TOML or JSON file with settings: gravity, tables noise, filter, graph."),
]
_RESULTS = "Folder for the results; replaces those of an earlier run. Default: "
RunOut = Annotated[Path | None, typer.Option(help=f"{_RESULTS}runs/NAME.")]
CompareOut = Annotated[Path | None, typer.Option(help=f"{_RESULTS}runs/compare.")]
EvaluateOut = Annotated[Path | None, typer.Option(help=f"{_RESULTS}none is written.")]
Fixes = Annotated[
    Path | None,
    typer.Option(
        help="CSV of absolute fixes with columns t, kind, x, y, z, sx, sy, sz: position \\[m], "
        "velocity \\[m/s] or yaw \\[rad] (in x), and their sigmas."
    ),
]
Grouping = Literal["set", "group", "person", "device", "place", "carry"]
By = Annotated[Grouping, typer.Option(help="What recordings are grouped by.")]
Jobs = Annotated[int, typer.Option(min=1, help="Number of processes that share the recordings.")]
Report = Annotated[
    bool, flag("--report", help="Also write report.html: map, time slider, plots, health.")
]
Tiles = Annotated[
    str,
    typer.Option(
        metavar="URL",
        help="Map server for the map's background, such as "
        "https://tile.openstreetmap.org/{z}/{x}/{y}.png; the browser asks it.",
    ),
]
Explain = Annotated[
    bool, flag("--explain", help="Say first what the printed words and figures mean.")
]
Overwrite = Annotated[bool, flag("--overwrite", help="Replace an existing file.")]
Json = Annotated[bool, flag("--json", help="Print the results as JSON on stdout.")]


@dataclass(frozen=True)
class Reading:
    """Options for reading a recording."""

    format: Annotated[
        str,
        _reading(
            help="Format: auto, or archive, ronin, ridi, imunet, rnin, tlio, bag, euroc (also "
            "TUM-VI), oxiod, advio, phone, joined, wide, events, zip, json, csv, long or untimed."
        ),
    ] = "auto"
    gyro_unit: Annotated[str, _reading(help="Unit of the gyroscope: rad/s, deg/s or mdps.")] = (
        "rad/s"
    )
    accel_unit: Annotated[
        str, _reading(help="Unit of the accelerometer: m/s^2, g, mg, -m/s^2, -g or -mg.")
    ] = "m/s^2"
    accel_sign: Annotated[
        str, _reading(help="Direction of the accelerometer at rest: up, or apple (down).")
    ] = "up"
    axes: Annotated[
        str,
        _reading(
            help="New x, y, z in the file's axes: y,-x,z makes its y the new x (or --axes=-y,x,z). "
            "They are those whose attitude the ground truth describes; without one, any will do."
        ),
    ] = "x,y,z"
    imu_topic: Annotated[str | None, _reading(help="IMU topic of a bag with several IMUs.")] = None
    truth_topic: Annotated[
        str | None, _reading(help="Topic of true poses or odometry in a bag.")
    ] = None
    rate: Annotated[
        float | None, _reading(help="Samples per second of a file that has no column of times.")
    ] = None
    gravity: Annotated[
        str,
        _reading(
            help="Gravity in the accelerometer: included, or removed and restored from the true "
            "attitude, or else the device's own."
        ),
    ] = "included"
    where: Annotated[
        list[str] | None,
        _reading(
            help="Only recordings of archives with this attribute, such as person=dan or "
            "'name=r*'. Repeatable: any value of one attribute, but all attributes must match."
        ),
    ] = None

    def changed(self) -> dict[str, object]:
        """Return the options that differ from their defaults."""
        default = asdict(Reading())
        return {name: value for name, value in asdict(self).items() if value != default[name]}

    def as_read(self) -> dict[str, object]:
        """Return the options that affect a recording's values: all except `where`."""
        return {name: value for name, value in asdict(self).items() if name != "where"}

    def recordings(self, paths: Iterable[Path]) -> tuple[list[Path], list[Skipped]]:
        """Return the recordings at the paths, in folders or list files, and the skipped paths.

        One that is named twice, such as by its folder and a list, is returned once: it would count
        twice in training and in intervals.
        """
        from stario.sequences.readers import find_recordings

        if self.format != "auto":  # a named format applies to the path itself
            if self.where:
                expected = "use with folders, lists or archives"
                raise InputError("--where", "use with --format", expected)
            return list(paths), []
        chosen = _attributes(self.where or ())
        files: list[Path] = []
        errors: list[StarioError] = []
        for path in paths:
            try:
                files += find_recordings(path, errors.append, chosen)
            except StarioError as error:
                errors.append(error)
        distinct: dict[Path, Path] = {}
        for path in files:
            distinct.setdefault(path.resolve(), path)
        return list(distinct.values()), [skipped("", error) for error in errors]

    def read(self, path: Path) -> ImuSequence:
        """Read a recording in rad/s, m/s^2 of specific force and the axes of its ground truth.

        Raises:
            InputError: it cannot be read; an option's invalid value is named by the option.
        """
        from stario.sequences.conventions import with_conventions
        from stario.sequences.readers import read_recording

        names = ("imu_topic", "truth_topic", "rate")
        given = {name: str(value) for name in names if (value := getattr(self, name)) is not None}
        meant = self.gyro_unit, self.accel_unit, self.axes, self.gravity, self.accel_sign
        try:
            return with_conventions(read_recording(path, self.format, **given), *meant)
        except InputError as error:
            if error.field not in self.as_read():
                raise
            field = f"--{error.field.replace('_', '-')}"
            raise InputError(field, error.found, error.expected, error.fix) from None


@dataclass(frozen=True)
class Estimator:
    """Options of the estimator."""

    config: Config = None
    model: Annotated[
        str, _estimation(help="Weights: default, open, or a safetensors or ONNX file.")
    ] = "default"
    magnetometer: Annotated[
        bool, _estimation(metavar="", help="Use the magnetometer, if there is one.")
    ] = True
    declination: Annotated[
        float | None,
        _estimation(
            min=-180.0,
            max=180.0,
            help="Magnetic declination in degrees east; the track's y axis then points north.",
        ),
    ] = None

    def settings(self) -> NavigatorConfig:
        """Return the navigator's settings.

        Raises:
            InputError: there is a declination, but the magnetometer is not used.
        """
        from stario.fusion.values.config import NavigatorConfig, read_config

        config = NavigatorConfig() if self.config is None else read_config(self.config)
        chosen = config.filter
        if not self.magnetometer:
            chosen = replace(chosen, magnetometer=False)
        if self.declination is not None:
            if not chosen.magnetometer:
                found, expected = "use with --no-magnetometer", "use with the magnetometer"
                raise InputError("--declination", found, expected)
            chosen = replace(chosen, declination=math.radians(self.declination))
        return replace(config, filter=chosen)

    def network(self) -> DisplacementModel:
        """Load the network with its weights."""
        from stario.network.model import load_model

        return load_model(self.model)


@dataclass(frozen=True)
class Map:
    """What is known of a place on the earth; as in `PlaceConfig`."""

    satellites: Annotated[
        str | None,
        _place(
            help="Satellite positions: use (as fixes), compare (with the track) or ignore. "
            "Default: compare."
        ),
    ] = None
    origin: Annotated[
        str | None,
        _place(
            metavar="LAT,LON[,YAW]",
            help="Latitude and longitude (-180 to 180, or 0 to 360 eastwards) of the start, or of "
            "the fixes' zero, in degrees, and perhaps the direction of the track's x axis, "
            "counter-clockwise from east.",
        ),
    ] = None

    def settings(self, config: NavigatorConfig) -> NavigatorConfig:
        """Return settings with these; without an option they keep their own.

        Raises:
            InputError: an option's value is none; it is named by the option.
        """
        given: dict[str, Any] = {name: value for name, value in asdict(self).items() if value}
        try:
            if self.origin is not None:
                given["origin"] = tuple(map(float, self.origin.split(",")))
            return replace(config, place=replace(config.place, **given))
        except InputError as error:
            raise InputError(f"--{error.field}", error.found, error.expected) from None
        except ValueError:
            expected = "numbers separated by commas, as in 48.137,11.575"
            raise InputError("--origin", repr(self.origin), expected) from None


@dataclass(frozen=True)
class Place(Map):
    """What is known of a recording's place, and what becomes of it."""

    waypoints: Annotated[
        str | None, _place(help="Known positions of the file, such as waypoints: use or compare.")
    ] = None
    closed: Annotated[
        bool, _place(metavar="", help="The track ends where it began, to a metre.")
    ] = False


READING, ESTIMATING = (tuple(f.name for f in fields(group)) for group in (Reading, Estimator))
"""Names of all options of both groups, to refuse them where they would do nothing."""


def refuse(context: typer.Context, found: str, expected: str, *names: str) -> None:
    """Refuse options of the command line that would do nothing, rather than ignore them.

    Raises:
        InputError: one of the named parameters was given; `found` says why it would do nothing,
            such as "without PATH", `expected` when it does something.
    """
    for option in context.command.params:
        source = context.get_parameter_source(str(option.name))
        if option.name in names and source is not None and source.name == "COMMANDLINE":
            spelled = option.opts if context.params[option.name] else option.secondary_opts
            raise InputError((spelled or option.opts)[0], f"use {found}", expected)


def expanded(command: Callable[..., None]) -> Callable[..., None]:
    """Put the options of groups, data classes such as `Reading`, in place of a command's groups."""
    options = [*_options(command)]

    @wraps(command)
    def flat(**values: Any) -> None:
        command(**_grouped(command, values))

    flat.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    flat.__annotations__ = {option.name: option.annotation for option in options}
    return flat


def _options(of: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """Yield the options of a command or of a group, and those of the groups in it."""
    for parameter in inspect.signature(of, eval_str=True).parameters.values():
        if _is_group(parameter):
            yield from _options(parameter.annotation)
        else:
            yield parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)


def _grouped(of: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a command or of a group from the values of all options."""
    arguments = {}
    for name, parameter in inspect.signature(of, eval_str=True).parameters.items():
        group, grouped = parameter.annotation, _is_group(parameter)
        arguments[name] = group(**_grouped(group, values)) if grouped else values[name]
    return arguments


def _is_group(parameter: inspect.Parameter) -> bool:
    return is_dataclass(parameter.annotation)


def _attributes(words: Iterable[str]) -> dict[str, list[str]]:
    """Return the patterns by attribute from `key=pattern` words."""
    chosen: dict[str, list[str]] = {}
    for word in words:
        key, pattern = assignment("--where", word, "attribute=value", "such as person=dan")
        chosen.setdefault(key, []).append(pattern)
    return chosen


def assignment(option: str, word: str, expected: str, example: str) -> tuple[str, str]:
    """Return what is left and right of the first `=` in the value of an option.

    Raises:
        InputError: there is no `=`, or nothing on one side of it.
    """
    key, _, value = word.partition("=")
    if not (key and value):
        raise InputError(option, repr(word), expected, example)
    return key, value
