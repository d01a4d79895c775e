"""Comparison of the tracks of one recording, with their errors if it has ground truth."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd

from stario.fusion.evaluation.known_positions import (
    MIN_POSITIONS,
    fitted_georeference,
    position_error,
    recording_verdict,
)
from stario.fusion.evaluation.pedestrian import pedestrian_track
from stario.fusion.evaluation.scores import scored
from stario.fusion.evaluation.tracks import (
    inertial_track,
    network_track,
    network_track_true_attitude,
    true_poses,
)
from stario.fusion.imu.inference import Predictor
from stario.fusion.navigator import Navigator
from stario.fusion.place import compared_with, used_words
from stario.fusion.recording import Progress, silent
from stario.fusion.report.health import LOST_YAW_SIGMA
from stario.fusion.values.config import NavigatorConfig, PlaceConfig
from stario.fusion.values.fix_file import check_within
from stario.fusion.values.fixes import Fix, fix_list
from stario.fusion.values.state import Track
from stario.sequences.accuracy.metrics import CONVENTIONS, Alignment, align, evaluate_track
from stario.sequences.accuracy.nees import position_nees
from stario.sequences.arrays import check_choice, check_type, short_repr
from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError
from stario.sequences.files import unused_name
from stario.sequences.findings import Finding
from stario.sequences.geodesy import Georeference
from stario.sequences.readers import read_recording
from stario.sequences.sequence import ImuSequence, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.magnetometer import INDOOR_FIELD
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.truth.problems import warn_of_truth

log = logging.getLogger(__name__)

TRACK_WORDS = {
    "track": "StarIO's track, smoothed: every pose uses all of the recording",
    "filtered": "the filter's track: every pose uses the samples until then, as a stream's",
    "network": "the network's displacements alone, along the gyroscope's attitude",
    "network_true_attitude": "the same, along the true attitude",
    "pdr": "pedestrian dead reckoning: steps of a common length, along the gyroscope's yaw",
    "dead_reckoning": "the IMU's samples integrated, as one would without StarIO",
}
"""Tracks of a recording and their meaning."""

TRACKS = tuple(TRACK_WORDS)

TRACK_TITLES = {
    "pdr": "steps (PDR)",
    "network_true_attitude": "network, true attitude",
    "network": "network, own attitude",
    "filtered": "filtered",
    "track": "track",
}
"""Titles of the columns of tracks."""

DEMONSTRATION_SEED = 2**31 + 49
"""Seed of the bundled demonstration: training seeds are below 2^31 and exclude this walk. 49 is the
number of the issue that asked for it, so chosen before its result was known."""

Metrics = dict[str, float | None]

METRIC_TITLES = {
    "ate_m": "ATE [m]",
    "ate_fit_m": "fitted [m]",
    "rte_m": "RTE [m]",
    "pde": "PDE [%]",
    "aye_rad": "AYE [deg]",
    "known_positions_m": "positions [m]",
    "nees_median": "NEES",
    "nis_mean": "NIS",
}
"""Columns of a table of tracks."""

METRIC_WORDS = {
    "ate_m": CONVENTIONS["ate_m"],
    "ate_fit_m": "ATE after a fit of yaw and position over all poses, which leaves errors in the "
    "track's shape and length only [m]",
    **{key: CONVENTIONS[key] for key in ("rte_m", "pde", "aye_rad", "coverage")},
    "known_positions_m": "root mean square of the horizontal distance to positions or waypoints "
    "known without attitude, after a fit of yaw and position [m]",
    "nees_median": "median over time of the 3-D position's NEES, aligned as the track "
    "(expected: 2.4, the median of chi-square with 3 degrees of freedom)",
    "nis_mean": "mean NIS of the network's measurements (expected: 3)",
    "seconds_network": "computing time of the network [s]",
    "seconds_filter": "computing time of everything except the network [s]",
    "alignment": "yaw and position of the first common pose; tilt is never aligned",
    "horizontal": "position errors and paths are in x and y only, except in the NEES",
}
"""Meaning of a track's figures in `metrics.json`."""

METRICS = tuple(name for name in METRIC_WORDS if name not in ("alignment", "horizontal"))
"""Figures of a track; null where unknown."""

RECORDING_WORDS = {
    "duration_s": "time between the recording's first and last sample [s]",
    "path_m": CONVENTIONS["path_m"],
}
"""Meaning of a recording's figures in the `metrics.json` of several."""

FULL_COVERAGE = 0.98
"""Share of a track below which the coverage by ground truth is reported as partial."""

MIN_COMPARED_S = 10.0
"""Compared time [s] below which there is no RTE, which would be an extrapolation to a minute."""

_FITTED = "least squares in yaw and position over all poses, because fixes define the frame"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Tracks of one recording and their metrics.

    Attributes:
        sequence: the recording.
        tracks: "track", and others by their names in `TRACKS`; those that could not be computed are
            missing, such as "network_true_attitude" without ground truth.
        metrics: metrics by track name.
        alignment: how tracks are aligned with the truth, for metrics and figures.
        train: command that trains weights on the recording, for the verdict; empty for none.
        used: what the tracks used of the recording's own positions, so that they are no truth.
    """

    sequence: ImuSequence
    tracks: dict[str, Track]
    metrics: dict[str, Metrics]
    alignment: Alignment = "first"
    train: str = ""
    used: tuple[str, ...] = ()

    @cached_property
    def verdict(self) -> list[Finding]:
        """What stands out about the recording and its main track, to act on first."""
        return recording_verdict(self.sequence, self.track, train=self.train)

    @property
    def track(self) -> Track:
        """StarIO's track, which words and innovations are about."""
        return self.tracks["track"]

    @cached_property
    def georeference(self) -> Georeference | None:
        """Where the frame of the tracks lies on the earth; None where that is unknown.

        It is given, or that of the positions used as fixes, if these have determined the direction;
        otherwise the track is fitted to known positions with coordinates.
        """
        sigma = self.track.health.final_sigma if self.track.health else {}
        if self.track.georeference is not None and sigma.get("yaw_rad", 0.0) < LOST_YAW_SIGMA:
            return self.track.georeference
        known = self.sequence.positions
        return None if known is None else fitted_georeference(self.track, known)

    @property
    def words(self) -> dict[str, str]:
        """Meaning of the metrics."""
        return METRIC_WORDS | ({"alignment": _FITTED} if self.alignment == "yaw" else {})

    @cached_property
    def path_m(self) -> float | None:
        """Length of the true path [m] that the track is compared with; None without truth.

        Like the errors it is horizontal and within the times compared.
        """
        truth = self.sequence.truth
        if truth is None:
            return None
        return evaluate_track(self.track.trajectory, truth, alignment="none").path_m

    @property
    def scores(self) -> pd.DataFrame:
        """The figures of all `TRACKS` as rows of `scores`; `duration_s` and `path_m` in each."""
        path_m = math.nan if self.path_m is None else self.path_m
        tracks = {name: self.metrics.get(name, dict.fromkeys(METRICS)) for name in TRACKS}
        duration_s = self.sequence.duration
        return scored(self.sequence.name, tracks, duration_s=duration_s, path_m=path_m)

    def aligned(self) -> dict[str, Trajectory]:
        """Return trajectories for figures, aligned with the truth if there is one."""
        truth = self.sequence.truth
        raw = {name: track.trajectory for name, track in self.tracks.items()}
        if truth is None:
            return raw
        return {name: align(track, truth, self.alignment) for name, track in raw.items()}


def compare(
    model: Predictor,
    sequence: ImuSequence,
    config: NavigatorConfig | None = None,
    progress: Progress = silent,
    fixes: Iterable[Fix] = (),
    names: Collection[str] = TRACKS,
) -> Comparison:
    """Compute tracks of a recording; they share predictions, and those of the filter use the fixes.

    Configuration, progress and fixes are those of `Navigator` and its `run`; `names` are those of
    the tracks, to which "track" is added.

    Raises:
        InputError: the recording is too short, its units or rate are wrong, no fix is within its
            time, a track does not exist, or an argument has the wrong type.
    """
    for name in names:
        check_choice("names", name, TRACKS)
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    fixes = fix_list(fixes)
    check_within(fixes, sequence)
    navigator = Navigator(model, config)
    config = navigator.config
    preprocessed = navigator.observe(sequence, progress)
    warn_of_truth(sequence)
    track = navigator.track(preprocessed, progress, fixes)
    assert track.filtered is not None  # a recording's track is smoothed
    filtered = track.filtered
    makers: dict[str, Callable[[], Track]] = {
        "track": lambda: track,
        "filtered": lambda: filtered,
        "network": lambda: network_track(preprocessed),
        "network_true_attitude": lambda: network_track_true_attitude(model, sequence, config),
        "pdr": lambda: pedestrian_track(sequence),
        "dead_reckoning": lambda: inertial_track(preprocessed, config),
    }
    if sequence.truth is None:
        del makers["network_true_attitude"]
    tracks: dict[str, Track] = {}
    for name in [name for name in makers if name in {"track", *names}]:
        try:
            tracks[name] = makers[name]()
        except InputError as error:
            log.warning("no track %s: %s", name, error)
    return measured(sequence, tracks, config.place)


def navigators(model: Predictor, config: NavigatorConfig, graph: bool) -> dict[str, Navigator]:
    """Return the filter, and perhaps the graph, by the names of the tracks they make."""
    filtered = {"filtered": Navigator(model, config, backend="ekf")}
    return filtered | ({"track": Navigator(model, config, backend="graph")} if graph else {})


def measured(
    sequence: ImuSequence, tracks: dict[str, Track], place: PlaceConfig | None = None
) -> Comparison:
    """Return tracks of a recording, of whose place this was used, with their metrics.

    If the truth is known at no time of the tracks, they are those of a recording without any.
    """
    place = place or PlaceConfig()
    used = used_words(sequence, place)
    sequence = replace(sequence, positions=compared_with(sequence, place))
    health = tracks["track"].health
    # Where fixes define the frame, the first pose's yaw is the least certain one.
    alignment: Alignment = "yaw" if health and health.fixes else "first"
    try:
        metrics = {name: measure(track, sequence, alignment) for name, track in tracks.items()}
    except InputError as error:
        if sequence.truth is None:
            raise
        log.warning("%s: no errors are computed: %s", sequence.name, error)
        return measured(replace(sequence, truth=None), tracks, place)
    return Comparison(sequence, tracks, metrics, alignment, used=used)


def measure(track: Track, sequence: ImuSequence, alignment: Alignment = "first") -> Metrics:
    """Compute the figures of a track, aligned as in `align`; None without truth or covariance."""
    figures: Metrics = dict.fromkeys(METRICS)
    truth = sequence.truth
    if truth is not None:
        moved = align(track.trajectory, truth, alignment)
        result = evaluate_track(moved, truth, alignment="none")
        names = ("ate_m", "rte_m", "pde", "aye_rad", "coverage")
        figures |= {name: getattr(result, name) for name in names}
        if result.duration_s < MIN_COMPARED_S:
            figures["rte_m"] = None
        figures["ate_fit_m"] = evaluate_track(track.trajectory, truth, alignment="yaw").ate_m
        if moved.position_covariance_W is not None:
            figures["nees_median"] = position_nees(moved, truth, "none").median
    elif sequence.positions is not None:
        error, count = position_error(track, sequence.positions)
        figures["known_positions_m"] = error if count >= MIN_POSITIONS else None
    figures["nis_mean"] = track.nis
    figures["seconds_network"] = track.seconds_network
    figures["seconds_filter"] = track.seconds_filter
    return figures


def compare_recordings(
    paths: Iterable[Path],
    model: Predictor | str,
    config: NavigatorConfig | None = None,
    read: Callable[[Path], ImuSequence] = read_recording,
    jobs: int | None = None,
    fixes: Iterable[Fix] = (),
    truth_needed: bool = False,
    progress: Progress = silent,
    names: Collection[str] = TRACKS,
) -> Iterator[Comparison | Skipped]:
    """Compare the tracks of each recording, in the order of the paths.

    Comparisons are yielded one by one, so that they need not all be in memory, under distinct
    names: a second `walk` is `walk-2`.

    Args:
        paths: paths of the recordings.
        model: network, or name of weights, which each process loads once: faster than passing the
            network with every recording.
        config: configuration of the navigator; None has its defaults.
        read: function that reads a path; must be picklable.
        jobs: number of processes, as for `stario.sequences.datasets.batch.each`.
        fixes: fixes given to the filter for every recording.
        truth_needed: whether to skip recordings without ground truth.
        progress: called with the share of the work done; with a single process also within a
            recording.
        names: tracks to compute, as for `compare`.

    Raises:
        InputError: `paths` is a single path, or an argument has the wrong type.
    """
    if isinstance(paths, str | Path):
        remedy = "find_recordings(path) returns one"
        raise InputError("paths", short_repr(paths), "a list of paths", remedy)
    paths, done = list(paths), 0

    def report_share(share: float) -> None:
        progress((done + share) / len(paths))

    work = partial(
        _compare,
        model=model,
        read=read,
        truth_needed=truth_needed,
        config=config,
        fixes=fix_list(fixes),
        names=names,
        progress=report_share if jobs == 1 else silent,
    )
    taken: set[str] = set()
    for outcome in each(work, paths, jobs):
        done += 1
        report_share(0.0)
        if isinstance(outcome, Comparison):
            name = distinct_name(outcome.sequence.name, taken)
            outcome = replace(outcome, sequence=replace(outcome.sequence, name=name))
        yield outcome


def distinct_name(name: str, taken: set[str]) -> str:
    """Return the name, or the first of name-2, name-3, ... not in `taken`, and add it there.

    It is also the name of a folder: an archive's `..` would be the one above.
    """
    found = unused_name(name if name.strip(".") else "recording", taken)
    taken.add(found)
    return found


def _compare(
    path: Path,
    model: Predictor | str,
    read: Callable[[Path], ImuSequence],
    truth_needed: bool,
    **options: Any,
) -> Comparison:
    sequence = read(path)
    if truth_needed:
        true_poses(sequence)
    return compare(_loaded(model) if isinstance(model, str) else model, sequence, **options)


@cache
def _loaded(name: str) -> Predictor:
    from stario.network.model import load_model

    return load_model(name)


def demonstration() -> ImuSequence:
    """Return the bundled demonstration: a simulated walk of two and a half minutes in a building.

    A phone with a magnetometer is held flat in front along the corridors, as one follows a map.
    """
    style = WalkStyle(carry="in-front")
    walk = generate_walk(DEMONSTRATION_SEED, duration=150.0, style=style, corridors=True)
    name = "demonstration"
    seed, field = DEMONSTRATION_SEED, INDOOR_FIELD
    return simulate_imu(walk, 200.0, PHONE_IMU, seed, name=name, magnetic_field=field)
