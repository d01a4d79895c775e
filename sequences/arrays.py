"""Array types of sequences, sums and means over samples, and validation of what users pass in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.sequences.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Choice = TypeVar("Choice", bound=str)


def correlation(x: FloatArray, y: FloatArray) -> float:
    """Return Pearson's correlation of arrays of equal shape; 0 if one is constant or too short."""
    if x.size < 3 or min(np.ptp(x), np.ptp(y)) == 0.0:
        return 0.0
    return float(np.corrcoef(x.ravel(), y.ravel())[0, 1])


def rms(rows: NDArray[np.floating]) -> float:
    """Return the root mean square of the lengths of rows (N, k)."""
    return float(np.sqrt(np.square(rows).sum(axis=1).mean()))


def scatter(rows: FloatArray) -> float:
    """Return the root mean square distance of rows (N, k) from their mean."""
    return float(np.linalg.norm(rows.std(axis=0)))


def peak_offset(before: float, peak: float, after: float) -> float:
    """Return where the parabola through three values peaks, in steps from the second one."""
    curvature = before - 2.0 * peak + after
    return 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0


def interpolated(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate columns of values (N, k) linearly at times (M,), clamped at the ends."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Return the maximal runs [start, stop) of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def even_grid(start: float, stop: float, step: float) -> FloatArray:
    """Return the times start, start + step, ... before `stop`, none of them at or beyond it.

    `np.arange` alone may end beyond `stop`: it rounds the number of steps up, and then each time.
    """
    grid = np.arange(start, stop, step, dtype=np.float64)
    return grid[grid < stop]


def evenly_spaced(count: int, most: int) -> NDArray[np.intp]:
    """Return up to `most` of `count` indices, evenly spaced from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))


def trapezoids(time: FloatArray, values: FloatArray) -> FloatArray:
    """Return the trapezoidal integrals (N - 1, k) of values (N, k) over the steps of time (N,)."""
    return np.asarray(0.5 * np.diff(time)[:, None] * (values[1:] + values[:-1]))


def integral(time: FloatArray, values: FloatArray) -> FloatArray:
    """Return the trapezoidal integral (N, k) over time (N,) of values (N, k), starting at 0."""
    steps = trapezoids(time, values)
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def samples_in(seconds: float, time: FloatArray) -> int:
    """Return the number of median steps of times (N,) [s] in a span [s], at least 1."""
    return max(1, round(seconds / float(np.median(np.diff(time)))))


def number_in(text: str) -> float:
    """Return the number that a text holds, NaN if it holds anything else."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def check_type(
    name: str, value: object, kind: type, remedy: str = "", optional: bool = False
) -> None:
    """Raise InputError unless an argument has the type, or is None if that is `optional`.

    It names the argument, and by `remedy` how to obtain a value of that type.
    """
    if not (isinstance(value, kind) or (optional and value is None)):
        expected = f"a value of type {kind.__name__}" + (" or None" if optional else "")
        raise InputError(name, short_repr(value), expected, remedy)


def check_choice(name: str, value: object, choices: Iterable[Choice]) -> Choice:
    """Return an argument; raise InputError, which names the choices, unless it is one of them."""
    known = tuple(choices)
    if not (isinstance(value, str) and value in known):
        raise InputError(name, short_repr(value), f"one of {', '.join(known)}")
    return known[known.index(value)]


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Return the random generator of a seed, one of its own for each `stream`.

    Raises InputError unless the seed is an integer >= 0.
    """
    if not (isinstance(seed, int | np.integer) and seed >= 0):
        raise InputError("seed", short_repr(seed), "an integer >= 0")
    return np.random.default_rng([int(seed), *stream] if stream else int(seed))


def short_repr(value: object) -> str:
    """Return a value as text for an error's single line."""
    return f"{' '.join(repr(value).split()):.60}"


def shortlist(names: Sequence[str], most: int = 5) -> str:
    """Return the first of the names for an error, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def as_float64(name: str, value: object) -> FloatArray:
    """Return an array-like as float64, NaN where a masked array has no value.

    Raises InputError if it holds dates, text or rows of unequal length.
    """
    try:
        masked = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else None
        array = np.asarray(value)
        if array.dtype.kind not in "Mm":
            array = np.asarray(array, dtype=np.float64)
            return array if masked is None else np.where(masked, np.nan, array)
    except (TypeError, ValueError):
        raise InputError(name, short_repr(value), "an array of numbers") from None
    remedy = f"({name} - {name}[0]) / np.timedelta64(1, 's') gives seconds since the first"
    raise InputError(name, f"values of type {array.dtype}", "numbers", remedy)


def finite_times(name: str, value: FloatArray) -> FloatArray:
    """Return times (N,) [s] in any order; raise InputError unless they are numbers, one or more."""
    time = as_float64(name, value)
    if time.ndim != 1 or time.size == 0:
        raise InputError(name, f"shape {time.shape}", "(N,) with at least one sample")
    return time


def checked_time(name: str, value: FloatArray) -> FloatArray:
    """Return times (N,) [s]; raise InputError unless they are finite and strictly increase."""
    time = finite_times(name, value)
    if not np.isfinite(time).all():
        raise InputError(name, "a value that is not finite", "finite seconds")
    steps = np.diff(time)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        raise InputError(
            name, f"{time[k + 1]!r} after {time[k]!r} at row {k + 1}", "strictly increasing seconds"
        )
    return time


def checked_valid(name: str, value: BoolArray, time: FloatArray) -> BoolArray:
    """Return flags (N,), all True if there are none; raise InputError if `time` (N,) has others."""
    valid = np.asarray(value, dtype=np.bool_)
    if valid.size == 0:
        return np.ones(len(time), dtype=np.bool_)
    if valid.shape != time.shape:
        raise InputError(name, f"shape {valid.shape}", f"({len(time)},) as time")
    return valid


def check_rotations(name: str, value: Rotation, time: FloatArray) -> None:
    """Raise InputError unless a value holds a rotation for each time (N,)."""
    check_type(name, value, Rotation, "Rotation.from_quat(quat_xyzw)")
    if value.single:  # it has no length
        raise InputError(name, "a single rotation", f"{len(time)} as time")
    if len(value) != len(time):
        raise InputError(name, f"{len(value)} rotations", f"{len(time)} as time")


def checked_array(
    name: str, value: FloatArray, shape: tuple[int, ...], where: BoolArray | bool = True
) -> FloatArray:
    """Return an array; raise InputError unless it has the shape, and finite rows at `where`."""
    array = as_float64(name, value)
    if array.shape != shape:
        raise InputError(name, f"shape {array.shape}", f"{shape}")
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1) & where
    if bad.any():
        raise InputError(
            name, f"a value that is not finite at row {int(np.argmax(bad))}", "finite values"
        )
    return array
