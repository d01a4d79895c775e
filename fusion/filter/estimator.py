"""The filter's recipe for one epoch: propagate, measure, update, clone, report.

Derivation: error, transition and measurement as in `stario.fusion.filter.ekf`; the displacement
between clones follows TLIO (Liu et al. 2020), on the right-invariant error (Barrau and Bonnabel
2017).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from stario.fusion.config import SMALLEST_SIGMA, NavigatorConfig
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import GateMode, UpdateResult
from stario.fusion.filter.estimate import Estimate, nav_states, smoothed_poses
from stario.fusion.filter.gyro_prior import GyroPrior
from stario.fusion.filter.history import History, Step
from stario.fusion.filter.history import Measurement as Measurement
from stario.fusion.filter.innovations import InnovationLog, count, is_gated
from stario.fusion.filter.jacobians import yaw_twist
from stario.fusion.filter.map_frame import KNOWN_YAW, UNKNOWN_YAW, WorldChange, WorldFrame
from stario.fusion.fixes import Accepted, Fix, parts
from stario.fusion.imu.intervals import Epoch, IntakeCounts, Start
from stario.fusion.imu.preintegration import Segment
from stario.fusion.imu.segments import segment_of
from stario.fusion.imu.stillness import RestDetector
from stario.fusion.imu.velocity_change import WindowMotion
from stario.fusion.lie import exp_so3
from stario.fusion.state import Health, Innovations, NavState, SmoothedPose
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

STILL_TILT_SIGMA = 0.01
"""Of the first attitude when the device was at rest [rad]."""

GAP_TURN = 0.5
"""How far a walker turns in a gap, one standard deviation per second [rad/s]: 0.4 to 1.0 over one
second and 0.36 to 0.7 per second over three in the training and validation recordings."""

WALKING_SPEED = 1.5
"""How far a walker gets in a long gap, per second and axis, one standard deviation [m/s]."""

FARTHEST = 1e4
"""No gap is taken to have led farther than this [m]: the covariance must keep its digits."""

_CHECKPOINT_SECONDS = 0.2
"""A late fix takes at most this much more filtering than its own lateness [s]."""


@dataclass(frozen=True, eq=False)
class PriorPose:
    """What is known of the first pose, at the time of the first sample.

    Attributes:
        R_WB: (3, 3) attitude.
        v_W: (3,) velocity [m/s].
        p_W: (3,) position [m].
        tilt_sigma: [rad].
        yaw_sigma: [rad].
        velocity_sigma: per axis [m/s].
        position_sigma: per axis [m].
    """

    R_WB: FloatArray
    v_W: FloatArray
    p_W: FloatArray
    tilt_sigma: float = 0.02
    yaw_sigma: float = 0.02
    velocity_sigma: float = 0.1
    position_sigma: float = 1e-3


class Held(NamedTuple):
    """A measurement of rest that the filter accepted: it stood still, and read only its bias."""

    b_g: FloatArray
    """(3,) mean rate [rad/s]."""
    covariance: FloatArray
    """(6, 6) of velocity [m^2/s^2] and rate [rad^2/s^2]; once per epoch, so wide as that."""


class FilterRecipe:
    """The state-cloning EKF driven by epochs.

    Args:
        config: noise and filter settings.
        start: time and levelled attitude of the first sample.
        prior: what is known of the first pose; None starts level, at rest, at the origin.
        streaming: True for streams: innovations are not kept, since memory must not grow, and the
            last second is, since fixes may come late.

    Attributes:
        ekf: the filter, by the wide one of the gyroscope's two priors (`gyro_prior`).
        oldest: the newest pose that left the window, corrected by all of it; None at first, and
            where mean velocities are measured.
        in_gap: whether the last epoch had no samples.
        held: what the last step measured at rest, None where it moved or was refused.
        segment: the last step's samples, None where fixes cut them.
        taken: the last step's measurement with its covariance as inflated, None where there was
            none, it was left out, or the device was at rest.
        accepted: fixes that the last call of `step` or `late_fix` took in, in order.
    """

    def __init__(
        self,
        config: NavigatorConfig,
        start: Start,
        prior: PriorPose | None = None,
        streaming: bool = False,
    ) -> None:
        f = config.filter
        self._config = config
        self._uses_clones = f.measurement == "displacement"
        self.ekf = StateCloningEkf(
            slots=f.window_updates if self._uses_clones else 0, gravity=config.gravity
        )
        self.gyro_prior = GyroPrior(config, start.time)
        self._slots: deque[int] = deque()
        self._motion = WindowMotion()
        self._gates = {n: float(chi2.ppf(f.gate, n)) for n in (3, 6)}
        self._log = InnovationLog(keep_rows=not streaming)
        self._rest = RestDetector(round(f.output_rate * WINDOW_SECONDS), f.rest_noise)
        self.held: Held | None = None
        self.segment: Segment | None = None
        self.taken: Measurement | None = None
        self.accepted: list[Accepted] = []
        self.oldest: Estimate | None = None
        self.in_gap = False
        self._gated_since: float | None = None
        self._world = WorldFrame(
            placed=prior is not None,
            oriented=prior is not None and prior.yaw_sigma <= KNOWN_YAW,
            gate=f.gate,
            prior=self.gyro_prior,
        )
        every = max(1, round(_CHECKPOINT_SECONDS * f.output_rate))
        self._history = History(every) if streaming else None
        self._start = start.time
        self._initialise(start, prior)

    def step(
        self, epoch: Epoch, measurement: Measurement | None, fixes: Sequence[Fix] = ()
    ) -> None:
        """Move to the epoch's end and take in the measurement of the window that ends there.

        Args:
            epoch: that follows the one before.
            measurement: None where no window ends, or nothing is known of it.
            fixes: with times up to the epoch's end that were not given before, in order.
        """
        if self._history is not None:
            before = self.checkpoint() if self._history.due() else None
            self._history.add(Step(epoch, measurement, list(fixes), before))
        self.accepted = []
        self._step(epoch, measurement, fixes)

    def late_fix(self, fix: Fix) -> bool:
        """Take in a fix at a time before now; False where it is more than a window late.

        The state is then the one it would be had the fix come in time.
        """
        if self._history is None or fix.time < max(self._start, self.ekf.time - WINDOW_SECONDS):
            return False
        done, self.accepted = False, []
        for step in self._history.insert(fix):
            if not done:
                assert step.before is not None  # the first one has it
                self.rewind(step.before)
            elif step.before is not None:
                step.before = self.checkpoint()
            self._step(step.epoch, step.measurement, step.fixes)
            done = True
        return done

    @property
    def judged(self) -> object:
        """What became of displacements and rest so far: a late fix may change it."""
        log = self._log
        return log.gated, dict(log.refused), dict(log.rests)

    @property
    def time(self) -> float:
        """Of the newest state [s]."""
        return self.ekf.time

    @property
    def world(self) -> int:
        """How often fixes moved or turned the world so far."""
        return len(self._world.changes)

    def estimate(self) -> Estimate:
        """The filter's newest state, by the wide one of the gyroscope's priors."""
        return self.ekf.estimate(self.in_gap, self.world)

    def state(self) -> NavState:
        """The newest state, by both of them."""
        return nav_states([self.estimate()], self.gyro_prior)[0]

    def filtered(self) -> NavState:
        """The newest state, by the wide one."""
        return nav_states([self.estimate()])[0]

    @property
    def smoothed(self) -> SmoothedPose | None:
        """`oldest` as callers get it."""
        clones = [] if self.oldest is None else [self.oldest]
        return next(iter(smoothed_poses(clones, self.gyro_prior)), None)

    def expected_gyro_bias(self) -> FloatArray | None:
        """Covariance (3, 3) to which the bias is expected to be zero beside the wide prior."""
        now = self.estimate()
        belief = self.gyro_prior.believe(np.array(now.time), now.b_g, now.P_gg)
        return None if belief is None else self.gyro_prior.covariance(float(belief.weight))

    @property
    def world_changes(self) -> list[WorldChange]:
        """How fixes moved and turned the world of the states given out so far."""
        return list(self._world.changes)

    @property
    def filter_changes(self) -> list[WorldChange]:
        """How they moved and turned that of `filtered`."""
        return list(self._world.filter_changes)

    def innovations(self) -> Innovations:
        """Every innovation so far."""
        return self._log.stacked()

    def health(self, counts: IntakeCounts, state: NavState | None = None) -> Health:
        """The report so far, with the sigmas of another estimator's state where one is given."""
        return self._log.health(counts, state or self.state())

    def checkpoint(self) -> dict[str, Any]:
        """Everything that `rewind` needs: arrays, numbers, text, lists and dictionaries."""
        return {
            "ekf": self.ekf.checkpoint(),
            "slots": list(self._slots),
            "gated_since": self._gated_since,
            "in_gap": self.in_gap,
            "oldest": self.oldest and vars(self.oldest),
            "motion": self._motion.checkpoint(),
            "log": self._log.checkpoint(),
            "rest": self._rest.checkpoint(),
            "world": self._world.checkpoint(),
        }

    def rewind(self, checkpoint: dict[str, Any]) -> None:
        """Go back to a checkpoint."""
        self.ekf.rewind(checkpoint["ekf"])
        self._slots = deque(checkpoint["slots"])
        self._gated_since = checkpoint["gated_since"]
        self.in_gap, oldest = checkpoint["in_gap"], checkpoint["oldest"]
        self.oldest = None if oldest is None else Estimate(**oldest)
        self._motion.rewind(checkpoint["motion"])
        self._log.rewind(checkpoint["log"])
        self._rest.rewind(checkpoint["rest"])
        self._world.rewind(checkpoint["world"])

    def dump(self) -> dict[str, Any]:
        """A stream's recipe for `load`: arrays, numbers, text, lists and dictionaries."""
        history = None if self._history is None else self._history.dump()
        return {"now": self.checkpoint(), "history": history}

    def load(self, dump: dict[str, Any]) -> None:
        """Become what was dumped by a recipe of the same configuration."""
        self.rewind(dump["now"])
        if self._history is not None:
            self._history.load(dump["history"])

    def _step(
        self, epoch: Epoch, measurement: Measurement | None, fixes: Sequence[Fix] = ()
    ) -> None:
        self.in_gap = epoch.gap
        if epoch.gap:
            self._forget_window()
        if epoch.anew is not None:
            self._begin_anew(epoch, epoch.anew)
            for _ in fixes:
                count(self._log.fixes, "in a long gap")
        elif not fixes:
            self._propagate(epoch)
        for piece, due in parts(epoch, fixes) if fixes and epoch.anew is None else ():
            if piece is not None:
                self._propagate(piece)
            for fix in due:
                self._take_fix(fix)
        if fixes:
            self.segment = None
        self.held = self._hold_still() if self._rest.at_rest(epoch) else None
        self.taken = None
        if self.held is not None:
            # Rest says it better than a network that learned from walking and sees 1 cm/s in it;
            # and a filter that agrees with it is not lost, whatever was left out before.
            self._gated_since = None
        elif measurement is not None:
            self.taken = self._update(epoch, measurement)
        if self._uses_clones and (epoch.update or epoch.gap):
            self._clone(epoch.stop)

    def _begin_anew(self, epoch: Epoch, start: Start) -> None:
        """Behind a long gap: tilt from gravity, speed and yaw unknown, somewhere in walking reach.

        Fixes within the gap are of no use: nothing ties their time to the samples behind it.
        """
        ekf, f = self.ekf, self._config.filter
        P, seconds = ekf.world_covariance(), epoch.stop - epoch.start
        covariance = np.zeros_like(P)
        tilt = STILL_TILT_SIGMA if start.still else f.tilt_sigma
        covariance[:3, :3] = np.diag(np.square([tilt, tilt, UNKNOWN_YAW]))
        covariance[3:6, 3:6] = max(f.velocity_sigma, SMALLEST_SIGMA) ** 2 * np.eye(3)
        reach = min(WALKING_SPEED * seconds, FARTHEST)
        covariance[6:9, 6:9] = P[6:9, 6:9] + reach**2 * np.eye(3)
        walks = np.repeat([self._config.noise.gyro_walk, self._config.noise.accel_walk], 3)
        turned_on = np.repeat([f.gyro_bias_sigma, f.accel_bias_sigma], 3)  # no walk goes far beyond
        drift = np.minimum(seconds * np.square(walks), np.square(turned_on))
        covariance[9:, 9:] = P[9:, 9:] + np.diag(drift)
        # What both priors of the gyroscope say of the position hangs on this.
        covariance[6:9, 9:], covariance[9:, 6:9] = P[6:9, 9:], P[9:, 6:9]
        yaw = yaw_twist(ekf.R_WB)
        turn = exp_so3(np.array([0.0, 0.0, yaw if math.isfinite(yaw) else 0.0]))
        R_WB, b_g, b_a = turn @ start.R_WB, ekf.b_g, ekf.b_a
        ekf.initialise(epoch.stop, R_WB, np.zeros(3), ekf.p_W, b_g, b_a, covariance)
        self._world.lose_yaw(ekf)

    def _propagate(self, epoch: Epoch) -> None:
        ekf, v_W, p_W = self.ekf, self.ekf.v_W, self.ekf.p_W
        self.segment = segment_of(epoch, ekf.R_WB, ekf.b_g, ekf.b_a, self._config)
        ekf.propagate(self.segment)
        if not self._uses_clones:
            self._motion.add(epoch.stop - epoch.start, v_W, p_W, ekf.v_W, ekf.p_W)
        if epoch.gap:
            ekf.loosen_yaw(p_W, min(GAP_TURN * (epoch.stop - epoch.start), UNKNOWN_YAW))
            self._world.lose_yaw(ekf)

    def _take_fix(self, fix: Fix) -> None:
        result, change = self._world.apply(self.ekf, fix)
        self._log.add_fix(result)
        if result.accepted:
            self.accepted.append(Accepted(fix, result.scale))
        if change is not None:
            self._motion.turn(change.R)

    def _hold_still(self) -> Held | None:
        ekf, noise = self.ekf, self._config.noise
        b_g = ekf.b_g
        residual, blocks, covariance = self._rest.measurement(ekf.v_W, b_g, noise)
        result = ekf.update_linear(residual, blocks, covariance, self._gates[6], "reject")
        self._log.add_rest(result)
        return Held(residual[3:] + b_g, covariance) if result.accepted else None

    def _initialise(self, start: Start, prior: PriorPose | None) -> None:
        f = self._config.filter
        tilt = STILL_TILT_SIGMA if start.still else f.tilt_sigma
        level = PriorPose(start.R_WB, np.zeros(3), np.zeros(3), tilt, f.yaw_sigma, f.velocity_sigma)
        pose = prior or level
        sigma = [pose.tilt_sigma] * 2 + [pose.yaw_sigma]
        sigma += [pose.velocity_sigma] * 3 + [pose.position_sigma] * 3
        sigma += [f.gyro_bias_sigma] * 3 + [f.accel_bias_sigma] * 3
        covariance = np.diag(np.square(np.maximum(sigma, SMALLEST_SIGMA)))
        zero = np.zeros(3)
        self.ekf.initialise(start.time, pose.R_WB, pose.v_W, pose.p_W, zero, zero, covariance)
        if self._uses_clones:
            self._clone(start.time)

    def _update(self, epoch: Epoch, measurement: Measurement) -> Measurement | None:
        # What is not finite is the filter's to refuse and count.
        with np.errstate(invalid="ignore"):
            result = self._offer(epoch, *measurement, self._gate_mode(epoch.stop))
        self._log.add(epoch.stop, result)
        if not is_gated(result):
            self._gated_since = self._gated_since if result.reason else None
        elif self._gated_since is None:
            self._gated_since = epoch.stop
        displacement_N, covariance_N = measurement
        return (displacement_N, result.scale * covariance_N) if result.accepted else None

    def _gate_mode(self, time: float) -> GateMode:
        since = self._gated_since
        longest = self._config.filter.gate_seconds
        return "reject" if time - (time if since is None else since) < longest else "inflate"

    def _offer(
        self,
        epoch: Epoch,
        displacement_N: FloatArray,
        covariance_N: FloatArray,
        gate_mode: GateMode,
    ) -> UpdateResult:
        covariance_N = covariance_N * self._config.filter.overlap_scale
        if self._uses_clones:
            slot = self._slots[0]
            R_WN = yaw_between(self.ekf.clone_pose(slot)[0], epoch.R_NB_window)
            return self.ekf.update_displacement(
                slot,
                None,
                R_WN @ displacement_N,
                R_WN @ covariance_N @ R_WN.T,
                self._gates[3],
                gate_mode,
            )
        R_WN = yaw_between(self.ekf.R_WB, epoch.R_NB)
        mean_W = R_WN @ displacement_N / WINDOW_SECONDS
        covariance = R_WN @ covariance_N @ R_WN.T / WINDOW_SECONDS**2
        # White noise of the force, weighted as the gain weights it.
        white = self._config.noise.accel_noise**2 * WINDOW_SECONDS / 3.0
        return self.ekf.update_mean_velocity(
            mean_W,
            covariance + white * np.eye(3),
            self._gates[3],
            gate_mode,
            self._motion.gain(),
            WINDOW_SECONDS,
        )

    def _clone(self, time: float) -> None:
        if len(self._slots) == self.ekf.slots:
            self.oldest = self.ekf.clone_estimate(self._slots[0], self.world)
            self.ekf.release(self._slots.popleft())
        self._slots.append(self.ekf.clone(time))

    def _forget_window(self) -> None:
        """No displacement spans a gap: its clones are of no more use."""
        while self._slots:
            self.ekf.release(self._slots.popleft())
        self._motion.clear()
        self._gated_since = None


def yaw_between(R_WB: FloatArray, R_NB: FloatArray | None) -> FloatArray:
    """R_WN about the vertical: from the levelled frame's yaw to the estimated world's."""
    assert R_NB is not None  # a window always comes with the attitude it started at
    R = R_WB @ R_NB.T
    sine, cosine = R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]
    norm = math.hypot(sine, cosine)
    s, c = (sine / norm, cosine / norm) if norm > 0.0 else (0.0, 1.0)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
