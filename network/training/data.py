"""Training data: the streams of recordings, and how often each is drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from stario.network.training.config import INSERTED, MADE, SIMULATED
from stario.sequences.arrays import rms
from stario.sequences.datasets.batch import Skipped
from stario.sequences.datasets.stream_cache import Stream
from stario.sequences.errors import ConfigError, InputError
from stario.sequences.files import unused_name
from stario.sequences.legs import LegStream
from stario.sequences.readers.archive import archive_attributes, split_name
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WINDOW_RATE, WorldStream

_SIMULATED_SHARE = 0.4
"""Default share of simulated walks among all windows."""

_SHORTEST = 400
"""Minimum number of samples of a stretch, 2 s; shorter ones are dropped."""


@dataclass(frozen=True)
class RecordingStreams:
    """Streams of a recording.

    Attributes:
        path: path of the recording.
        streams: its unbroken stretches.
        licence: licence named in its file.
        is_virtual: whether a virtual device on motion capture recorded it.
    """

    path: Path
    streams: Sequence[Stream]
    licence: str = ""
    is_virtual: bool = False

    @property
    def has_poses(self) -> bool:
        """Whether a real device recorded it, with poses as ground truth."""
        return not self.is_virtual and any(isinstance(s, WorldStream) for s in self.streams)


def recording_streams(
    outcomes: Iterable[tuple[Path, Sequence[Stream] | Skipped]],
) -> tuple[list[RecordingStreams], list[Skipped]]:
    """Return the streams of each recording with its licence, and those that were skipped.

    A second recording called `walk` becomes `walk-2`.

    Args:
        outcomes: paths, each with the outcome of `stario.sequences.datasets.stream_cache.recorded`.
    """
    recordings: list[RecordingStreams] = []
    skipped: list[Skipped] = []
    names: set[str] = set()
    for path, outcome in outcomes:
        if isinstance(outcome, Skipped):
            skipped.append(outcome)
        else:
            name = unused_name(outcome[0].name, names)  # validation averages over names
            names.add(name)
            if name != outcome[0].name:
                outcome = [replace(stream, name=name) for stream in outcome]
            licence = str(archive_attributes(path).get("licence", ""))
            recordings.append(RecordingStreams(path, outcome, licence))
    return recordings, skipped


@dataclass(frozen=True)
class TrainingData:
    """Streams to learn from, or to select weights and calibrate on.

    Attributes:
        streams: stretches with full ground truth.
        weights: how often each is drawn, relative to others, per second of its length; by default
            all alike.
        legs: stretches of weak truth, positions or waypoints.
        words: description of the sources, for the card.
        simulated: whether all `streams` are simulated: legs, if there are any, then select the
            weights alone.

    Raises:
        InputError: the number of weights is not that of streams.
    """

    streams: Sequence[WorldStream]
    weights: Sequence[float] = ()
    legs: Sequence[LegStream] = ()
    words: Sequence[str] = ()
    simulated: bool = False

    def __post_init__(self) -> None:
        if not len(self.weights):
            object.__setattr__(self, "weights", [1.0] * len(self.streams))
        if len(self.weights) != len(self.streams):
            expected = f"{len(self.streams)}, one for each stream"
            raise InputError("weights", str(len(self.weights)), expected)


def mix_sources(
    recorded: Sequence[RecordingStreams],
    generated: Sequence[WorldStream],
    shares: Mapping[str, float] = MappingProxyType({}),
    reach: int = 1,
    moments: Sequence[WorldStream] = (),
) -> TrainingData:
    """Mix recordings and simulated walks so that each source makes up its share of the windows.

    Args:
        recorded: streams of each recording.
        generated: simulated walks.
        shares: share of each source among the recordings' windows, by a folder, archive or file in
            their paths, with or without its suffix; other recordings make up the rest of 1. The
            share of a source that is absent goes to the others. `SIMULATED` and `INSERTED` are the
            shares of simulated walks and of `moments` among all windows.
        reach: minimum number of samples of a stream to draw from (`TrainingConfig.reach`).
        moments: streams of recordings with bad moments inserted.

    Raises:
        ConfigError: the named shares leave nothing for other recordings, those of walks and moments
            exceed 1, or all shares are 0.
    """
    streams: list[WorldStream] = []
    weights: list[float] = []
    simulated = shares.get(SIMULATED, _SIMULATED_SHARE)
    inserted = shares.get(INSERTED, 0.0) if moments else 0.0
    if simulated + inserted > 1.0 + 1e-9:
        found = f"{simulated + inserted:g} for simulated walks and moments"
        raise ConfigError("shares", found, "a sum of 1 or less")
    named = _sources(recorded, shares)
    present = sum(share for _, share, members in named if any(len(s) >= reach for s in members))
    rest = (1.0 - simulated - inserted) / (present or 1.0)
    sources = [(f"recorded, {name}", rest * share, members) for name, share, members in named]
    sources.append(("simulated walks", simulated, list(generated)))
    sources.append(("recordings with bad moments", inserted, list(moments)))
    # Errors are large where motion is wild; of motion capture, that is not worth learning most.
    real = {id(s) for recording in recorded if not recording.is_virtual for s in recording.streams}
    words = []
    for name, share, members in sources:
        if not members:
            continue
        lively = [_motion_intensity(s) if id(s) in real else 1.0 for s in members]
        starts = [max(0, len(s) - reach + 1) for s in members]
        whole = sum(v * n for v, n in zip(lively, starts, strict=True)) / WINDOW_RATE
        streams += members
        weights += [share * v / whole if whole else 0.0 for v in lively]
        words.append(f"{name}: {_length(members)}")
    if any(len(s) >= reach for s in streams) and not any(weights):
        raise ConfigError("shares", "0 for every source present", "at least one above 0")
    legs = [s for recording in recorded for s in recording.streams if isinstance(s, LegStream)]
    for kind in dict.fromkeys(stream.kind for stream in legs):
        words.append(f"{kind}: {_length([s for s in legs if s.kind == kind])}")
    simulated = not any(len(members) for _, _, members in named)
    return TrainingData(streams, weights, legs, words + _licences(recorded), simulated)


def validation_data(
    recorded: Sequence[RecordingStreams], walks: Callable[[], list[WorldStream]]
) -> TrainingData:
    """Return the streams of held-out recordings, with simulated walks if none of them has poses.

    Sigma needs windows with full ground truth.
    """
    held = mix_sources(recorded, [])
    return held if held.streams else mix_sources(recorded, walks())


def _licences(recorded: Sequence[RecordingStreams]) -> list[str]:
    """Describe each archive's licences and how much training data is under each."""
    known: dict[str, list[RecordingStreams]] = {}
    for recording in recorded:
        if recording.licence:
            file = split_name(recording.path)[0].name
            known.setdefault(f"{file}, licence {recording.licence}", []).append(recording)
    return [
        f"{words}: {len(members)} recordings, "
        f"{_length([stream for recording in members for stream in recording.streams])}"
        for words, members in known.items()
    ]


def _sources(
    recorded: Sequence[RecordingStreams], shares: Mapping[str, float]
) -> list[tuple[str, float, list[WorldStream]]]:
    """Return name, share and streams of each source of recordings with full truth."""
    shares = {name: share for name, share in shares.items() if name not in MADE}
    members: dict[str, list[WorldStream]] = {name: [] for name in [*shares, ""]}
    for recording in recorded:
        source = next((name for name in shares if _is_in(recording.path, name)), "")
        members[source] += [s for s in recording.streams if isinstance(s, WorldStream)]
    left = 1.0 - sum(shares.values())
    if members[""] and left < 1e-9:
        raise ConfigError(
            "shares", "a sum of 1 or more", "less than 1", f"{members[''][0].name} matches no share"
        )
    return [(name or "others", shares.get(name, left), found) for name, found in members.items()]


def _is_in(path: Path, source: str) -> bool:
    """Return whether a source names folders, the archive or the file of a recording, or itself."""
    file, member = split_name(path)
    places = file.as_posix(), (file.parent / file.stem).as_posix(), member
    return any(f"/{source.strip('/')}/" in f"/{place}/" for place in places)


def seconds_of(streams: Iterable[Stream]) -> float:
    """Return the total length of streams [s]."""
    return sum(map(len, streams)) / WINDOW_RATE


def _length(streams: Sequence[Stream]) -> str:
    seconds = seconds_of(streams)
    return f"{seconds / 60.0:.0f} min" if seconds >= 120.0 else f"{seconds:.0f} s"


def _motion_intensity(stream: WorldStream) -> float:
    """Return the root mean square linear acceleration [m/s^2]: errors are large where it is."""
    linear = stream.imu_W[::10, 3:] - np.array([0.0, 0.0, STANDARD_GRAVITY], np.float32)
    return rms(linear)


def split_off(
    recordings: Sequence[RecordingStreams],
) -> tuple[list[RecordingStreams], list[RecordingStreams]]:
    """Split the last fifth off each recording; drop parts that are too short to learn from."""
    first, last = [], []
    for recording in recordings:
        remaining = round(0.8 * sum(len(stream) for stream in recording.streams))
        before, after = [], []
        for stream in recording.streams:
            before.append(stream.part(0, remaining))
            after.append(stream.part(max(remaining, 0), len(stream)))
            remaining -= len(stream)
        first.append(replace(recording, streams=[s for s in before if _is_long(s)]))
        last.append(replace(recording, streams=[s for s in after if _is_long(s)]))
    return first, last


def _is_long(stream: Stream) -> bool:
    return len(stream) >= _SHORTEST and (isinstance(stream, WorldStream) or len(stream.start) > 1)
