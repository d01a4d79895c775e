"""The navigator: one recipe for streams and recordings.

Samples become epochs (`intake`), the windows of epochs become displacements (the network), and
both move the filter (`recipe`). A stream does this sample by sample; a recording lets the network
see many windows at once. As the intake does not depend on the filter both give the same track.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from stario.fusion.checked import floored
from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.estimate import Estimate, nav_states, smoothed_poses
from stario.fusion.filter.estimator import FilterRecipe, Measurement, PriorPose
from stario.fusion.filter.map_frame import in_last_world, smoothed_track
from stario.fusion.fixes import Fix, FixQueue, heading_fix, position_fix, velocity_fix
from stario.fusion.graph.batch import smooth
from stario.fusion.graph.builder import Taken
from stario.fusion.graph.fixed_lag import GraphRecipe
from stario.fusion.imu.front_end import Intake, all_epochs
from stario.fusion.imu.intervals import Epoch, Start
from stario.fusion.imu.stateful import AlongTrack
from stario.fusion.imu.stateful import Predictor as Predictor
from stario.fusion.snapshot import check_same, pack, unpack
from stario.fusion.state import Health, NavState, SmoothedPose, Track, track_from_states
from stario.sequences.checks import check_units
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.windows import WINDOW_SECONDS

Vector = Sequence[float] | FloatArray
"""Three numbers."""

_START_FORCE = (5.0, 15.0)
"""Average force [m/s^2] of a first second that may hold a jump, but neither g nor deg/s."""

Backend = Literal["ekf", "graph"]
"""The filter; or the factor graph, fixed-lag for streams and of the whole for recordings."""

LEAST_SIGMA = 5e-3
"""No network knows a second's displacement better than this [m], whatever it says."""

SUSPECT_SCALE = 4.0
"""On the network's covariance where a window has spikes or saturated samples: twice the sigma."""

_BATCH = 512
"""Windows of a recording that the network is given at once."""

Progress = Callable[[float], None]
"""Called with the share of the work done, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Observed:
    """A recording as the filter sees it: epochs, and the network's word on each window.

    Attributes:
        epochs: in order.
        measurements: one for each epoch, None where there is no window.
        intake: with its counts and the start.
        seconds_intake: computing time [s].
        seconds_network: computing time [s].
    """

    epochs: list[Epoch]
    measurements: list[Measurement | None]
    intake: Intake
    seconds_intake: float
    seconds_network: float


class Navigator:
    """Inertial navigation with a displacement network.

    Args:
        model: a `DisplacementModel`, or anything with its `predict`.
        config: noise, filter, gravity; the defaults are those of handheld devices.
        prior: what is known of the first pose; None starts level by gravity, yaw and position zero.
        backend: "ekf", or "graph" for the factor graph, which is more accurate and takes more time.

    Raises:
        InputError: there is no such back end.
    """

    def __init__(
        self,
        model: Predictor,
        config: NavigatorConfig | None = None,
        prior: PriorPose | None = None,
        backend: Backend = "ekf",
    ) -> None:
        if backend not in get_args(Backend):
            raise InputError("backend", repr(backend), f"one of {', '.join(get_args(Backend))}")
        self.backend = backend
        self.model = model
        self.prior = prior
        self.config = config or NavigatorConfig()
        self._intake = Intake(self.config)
        self._recipe: FilterRecipe | GraphRecipe | None = None
        self._fixes = FixQueue()
        self._network = self._along_track()

    def push(self, time: float, gyro: Vector, accel: Vector) -> NavState | None:
        """Take in one sample of a stream.

        Samples that are not finite, repeated or late are dropped and counted (`health`); gaps are
        noticed by themselves. The first state comes one second after the first sample.

        Args:
            time: [s].
            gyro: (3,) angular rate in B [rad/s].
            accel: (3,) specific force in B [m/s^2].

        Returns:
            The newest state if this sample completed an update period, else None.

        Raises:
            InputError: time is no number, or every sample is far from the one before, as where it
                is not in seconds; gyro or accel does not hold three; the first second's average
                force cannot be gravity in m/s^2, or gyro cannot be in rad/s, which shows once the
                device turns. In the last two cases the stream then begins anew.
        """
        sample = (_seconds(time), *_three("gyro", gyro), *_three("accel", accel))
        state = None
        for epoch in self._intake.push(sample):
            self._check_gyro(epoch)
            state = self._advance(epoch)
        return state

    def update_position(self, time: float, p_W: ArrayLike, covariance: ArrayLike) -> None:
        """A position fix for the stream.

        It is taken in at its own time: up to a window (1 s) before the newest state, or later,
        when the stream gets there. Older ones, and values that are not finite or no covariance,
        are refused and counted in `health`. A track that started without a pose is moved to its
        first position fix and turned by the second that is far enough away (see `world`): states
        with another `world` must not be compared with those before.

        Args:
            time: [s], on the samples' clock.
            p_W: (3,) [m].
            covariance: (3, 3) [m^2].

        Raises:
            InputError: a value has another shape.
        """
        self._take(position_fix(time, p_W, covariance))

    def update_velocity(self, time: float, v_W: ArrayLike, covariance: ArrayLike) -> None:
        """A velocity fix (3,) [m/s] with covariance (3, 3); else as `update_position`."""
        self._take(velocity_fix(time, v_W, covariance))

    def update_heading(self, time: float, yaw: float, sigma: float) -> None:
        """A fix of the body's yaw [rad], that of `yaw_of`; else as `update_position`."""
        self._take(heading_fix(time, yaw, sigma))

    @property
    def state(self) -> NavState | None:
        """The newest state of the stream, None before the first second is over."""
        return None if self._recipe is None else self._recipe.state()

    @property
    def smoothed(self) -> SmoothedPose | None:
        """The stream's newest pose one window (1 s) late, corrected by all measured since.

        It comes with each network update; None before the first, and where there are no clones
        (`measurement` "velocity") or the back end is not the EKF.
        """
        return self._recipe.smoothed if isinstance(self._recipe, FilterRecipe) else None

    @property
    def health(self) -> Health:
        """The stream's report so far."""
        counts = self._intake.counts
        health = counts.health() if self._recipe is None else self._recipe.health(counts)
        return _with_refused(health, self._fixes)

    def snapshot(self) -> bytes:
        """The stream as it is now, to be continued by `restore`, in another process if need be.

        The bytes' format is documented in `stario.fusion.snapshot`; nothing in it is pickled. They
        hold neither configuration files nor weights, only what tells them.

        Raises:
            InputError: the back end cannot be continued.
        """
        recipe = self._recipe
        if recipe is not None and not isinstance(recipe, _Continued):
            raise InputError(
                "snapshot", f"the back end {self.backend}", "one that can be continued"
            )
        return pack(
            {
                "backend": self.backend,
                "config": asdict(self.config),
                "model": _fingerprint(self.model),
                "prior": None if self.prior is None else vars(self.prior),
                "intake": self._intake.checkpoint(),
                "fixes": self._fixes.checkpoint(),
                "network": self._network.checkpoint(),
                "recipe": None if recipe is None else recipe.dump(),
            }
        )

    def restore(self, data: bytes) -> None:
        """Continue the stream of a `snapshot`: the states are the same as without the break.

        The navigator must have the same back end, configuration and weights; its own stream, and
        its prior, are given up for the snapshot's.

        Raises:
            InputError: the bytes are no whole snapshot of this version, or one of another back end,
                configuration or model. The navigator is then as it was before.
        """
        tree = unpack(data)
        check_same("backend", tree["backend"], self.backend)
        check_same("config", tree["config"], asdict(self.config))
        check_same("model", tree["model"], _fingerprint(self.model))
        prior = None if tree["prior"] is None else PriorPose(**tree["prior"])
        intake, fixes, recipe = Intake(self.config), FixQueue(), None
        intake.rewind(tree["intake"])
        fixes.rewind(tree["fixes"])
        network = self._along_track()
        network.rewind(tree["network"])
        if tree["recipe"] is not None:
            assert intake.start is not None  # there is no recipe without one
            recipe = self._new_recipe(intake.start, prior)
            recipe.load(tree["recipe"])
        self.prior, self._intake, self._fixes, self._recipe = prior, intake, fixes, recipe
        self._network = network

    def run(
        self,
        sequence: ImuSequence,
        progress: Progress = lambda share: None,
        fixes: Iterable[Fix] = (),
    ) -> Track:
        """The fused track of a recording; its truth is never looked at.

        Does not touch the stream of `push`.

        Args:
            sequence: the recording.
            progress: called now and then with the share of the work done.
            fixes: of position, heading or velocity, in any order; those outside the recording, or
                without meaning, are refused and counted. The whole track is given in the world it
                ends in.

        Raises:
            InputError: the recording is shorter than 1.5 s, or its units or rate are wrong.
        """
        return self.track(self.observe(sequence, progress), progress, fixes)

    def observe(self, sequence: ImuSequence, progress: Progress = lambda share: None) -> Observed:
        """Prepare a recording and let the network see its windows.

        Raises:
            InputError: as for `run`.
        """
        check_units(sequence)
        began = perf_counter()
        epochs, intake = all_epochs(sequence, self.config)
        if intake.start is None or not any(e.window is not None for e in epochs):
            raise InputError(
                f"{sequence.name}: samples",
                f"{intake.counts.used} usable over {sequence.duration:.2f} s",
                f"an unbroken stretch of at least {WINDOW_SECONDS:g} s",
            )
        seconds_intake = perf_counter() - began
        progress(0.1)
        began = perf_counter()
        measurements = self._measure(epochs, progress)
        return Observed(epochs, measurements, intake, seconds_intake, perf_counter() - began)

    def track(
        self,
        observed: Observed,
        progress: Progress = lambda share: None,
        fixes: Iterable[Fix] = (),
    ) -> Track:
        """The back end's track of a prepared recording; fixes as for `run`."""
        began = perf_counter()
        start = observed.intake.start
        assert start is not None  # observe() refuses recordings without one
        recipe = FilterRecipe(self.config, start, self.prior)
        queue = FixQueue(fixes)
        queue.start(start.time)
        estimates, taken = [recipe.estimate()], []
        clones: list[Estimate] = []
        for k, (epoch, measurement) in enumerate(
            zip(observed.epochs, observed.measurements, strict=True)
        ):
            due = queue.due(epoch.stop)
            recipe.step(epoch, measurement, due)
            estimates.append(recipe.estimate())
            if recipe.oldest is not None and (not clones or recipe.oldest is not clones[-1]):
                clones.append(recipe.oldest)
            accepted = [fix for fix, _scale in recipe.accepted]
            walked = measurement if recipe.held is None else None
            taken.append(Taken(epoch, walked, accepted, recipe.held, recipe.segment))
            if k % 500 == 0:
                progress(0.6 + 0.4 * k / len(observed.epochs))
        progress(1.0)
        queue.refuse("after the end", len(queue.due(math.inf)))
        changes, notes = recipe.world_changes, []
        states: list[NavState] = []
        if self.backend == "graph":
            own, wide = recipe.filter_changes, nav_states(estimates)
            filtered, expected = in_last_world(wide, own), recipe.expected_gyro_bias()
            whole = smooth(filtered, wide[0], taken, own, self.config, expected)
            notes, clones = [whole.note], []
            states = [] if whole.fell_back else whole.states
        if not states:
            states = in_last_world(nav_states(estimates, recipe.gyro_prior), changes)
        poses = smoothed_poses(clones, recipe.gyro_prior)
        health = replace(recipe.health(observed.intake.counts, states[-1]), notes=notes)
        track = track_from_states(
            states,
            recipe.innovations(),
            _with_refused(health, queue),
            seconds_network=observed.seconds_network,
            seconds_filter=observed.seconds_intake + perf_counter() - began,
        )
        return replace(track, smoothed=smoothed_track(poses, changes))

    def _measure(self, epochs: Sequence[Epoch], progress: Progress) -> list[Measurement | None]:
        measurements: list[Measurement | None] = [None] * len(epochs)
        network = self._along_track()
        for part in _parts(epochs, unbroken=network.remembers):
            if network.remembers and epochs[part[0]].gap:
                network.restart()
            known = [k for k in part if epochs[k].window is not None]
            if not known:
                continue
            windows_N = np.stack([_window(epochs[k]) for k in known])
            heading = np.array([epochs[k].heading for k in known])
            mean, covariance = network.predict(windows_N, heading)
            for k, d_N, cov_N in zip(known, mean, covariance, strict=True):
                measurements[k] = _measurement(epochs[k], d_N, cov_N)
            progress(0.1 + 0.5 * (part[-1] + 1) / len(epochs))
        return measurements

    def _along_track(self) -> AlongTrack:
        return AlongTrack(self.model, self.config.filter.window_updates)

    def _advance(self, epoch: Epoch) -> NavState:
        if self._recipe is None:
            start = self._checked_start()
            self._recipe = self._new_recipe(start, self.prior)
            self._fixes.start(start.time)
        measurement = None
        if epoch.gap:
            self._network.restart()
        if epoch.window is not None:
            heading = np.array([epoch.heading])
            mean, covariance = self._network.predict(epoch.window[None], heading)
            measurement = _measurement(epoch, mean[0], covariance[0])
        self._recipe.step(epoch, measurement, self._fixes.due(epoch.stop))
        return self._recipe.state()

    def _new_recipe(self, start: Start, prior: PriorPose | None) -> Any:
        if self.backend == "graph":
            return GraphRecipe(self.config, start, prior)
        return FilterRecipe(self.config, start, prior, streaming=True)

    def _take(self, fix: Fix) -> None:
        if self._recipe is None or fix.fault() or fix.time > self._recipe.time:
            self._fixes.hold(fix)
        elif not self._recipe.late_fix(fix):
            self._fixes.refuse("too late")

    def _check_gyro(self, epoch: Epoch) -> None:
        try:
            self._intake.gyro_unit.look(epoch)
        except InputError:
            self._intake, self._recipe = Intake(self.config), None
            self._network = self._along_track()
            raise

    def _checked_start(self) -> Start:
        """A stream cannot be checked as a whole before it runs: its first second is."""
        start = self._intake.start
        assert start is not None  # set before the first epoch
        if not _START_FORCE[0] <= start.force <= _START_FORCE[1]:
            self._intake = Intake(self.config)
            raise InputError(
                "accel",
                f"an average of {start.force:.3g} over the first second",
                f"about {self.config.gravity:.2f} m/s^2",
                "give specific force in m/s^2 with gravity left in, and rates in rad/s",
            )
        return start


def _parts(epochs: Sequence[Epoch], unbroken: bool) -> Iterator[range]:
    """Runs of epochs whose windows the network sees at once; `unbroken` ones end at a gap."""
    begin = windows = 0
    for k, epoch in enumerate(epochs):
        if windows == _BATCH or (unbroken and epoch.gap and k > begin):
            yield range(begin, k)
            begin, windows = k, 0
        windows += epoch.window is not None
    yield range(begin, len(epochs))


def _with_refused(health: Health, queue: FixQueue) -> Health:
    waiting = {"waiting": len(queue)} if len(queue) else {}
    return replace(health, fixes=health.fixes | queue.refused | waiting)


@runtime_checkable
class _Continued(Protocol):
    """A recipe that can be stopped and continued."""

    def dump(self) -> dict[str, Any]: ...

    def load(self, dump: dict[str, Any]) -> None: ...


def _fingerprint(model: Predictor) -> str:
    """What tells a model's weights, empty where it has no card."""
    return str(getattr(getattr(model, "card", None), "sha256", ""))


def _window(epoch: Epoch) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    assert epoch.window is not None  # only epochs that have one are asked
    return epoch.window


def _measurement(epoch: Epoch, d_N: FloatArray, covariance_N: FloatArray) -> Measurement:
    """What the network says of a window, as far as it can be trusted."""
    if epoch.suspect:
        covariance_N = SUSPECT_SCALE * covariance_N
    return d_N, floored(covariance_N, LEAST_SIGMA)


def _seconds(time: float) -> float:
    try:
        return float(time)
    except (TypeError, ValueError):
        raise InputError("time", repr(time), "a number of seconds") from None


def _three(name: str, value: Vector) -> tuple[float, float, float]:
    try:
        x, y, z = map(float, value)
    except (TypeError, ValueError):
        raise InputError(name, repr(value), "three numbers in body axes") from None
    return x, y, z
