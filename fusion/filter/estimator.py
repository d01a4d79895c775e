"""The filter driven by successive IMU intervals: propagate, zero velocity, update, clone.

README.md, "One interval".
"""

from __future__ import annotations

from collections.abc import Sequence

from stario.fusion.filter import displacements, ekf, height, magnetic, map_frame
from stario.fusion.filter.correlated_errors import ACCEL_SHARE
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.estimator_state import EstimatorState, rewound, with_step
from stario.fusion.filter.gained import Gained, gained_information
from stario.fusion.filter.gyro_bias import GyroBiasPrior, first_prior, is_due, with_prior_replaced
from stario.fusion.filter.initial import (
    PriorPose,
    first_state,
    state_after_loss,
    tilt_sigma,
    with_velocity_bounded,
)
from stario.fusion.filter.jacobians import GYRO_BIAS
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.filter.map_frame import Mapped
from stario.fusion.filter.record import Record
from stario.fusion.filter.zero_velocity import ZeroVelocity, update_zero_velocity
from stario.fusion.imu.barometer import UNKNOWN_RATE
from stario.fusion.imu.gap import INTERPOLATED
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.imu.intervals import ImuInterval, Start, split_at_fixes
from stario.fusion.imu.preintegration import Segment, segment_of
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Accepted, Fix, by_time
from stario.fusion.values.state import changed


def begin(
    config: NavigatorConfig,
    start: Start,
    prior: PriorPose | None = None,
    streaming: bool = False,
) -> EstimatorState:
    """Return the first state.

    Args:
        config: noise and filter settings.
        start: time and levelled attitude of the first sample.
        prior: prior on the first pose; None starts levelled, at rest, at the origin.
        streaming: True for streams: the steps of the last second are kept, since fixes may arrive
            late.

    Raises:
        InputError: gravity contradicts the prior's attitude.
    """
    s = EstimatorState(
        begun=start.time,
        ekf=first_state(start, prior, config),
        map_frame=map_frame.first_frame(prior),
        bias_prior=first_prior(config.filter),
        history=() if streaming else None,
    )
    if config.filter.adaptive:
        s = _with_prior(s, s.bias_prior.widest(), config)
    return _with_clone(s)


def step(
    s: EstimatorState,
    interval: ImuInterval,
    displacement: WindowDisplacement | None,
    fixes: Sequence[Fix],
    config: NavigatorConfig,
) -> tuple[EstimatorState, Record]:
    """Move to an interval's end and apply the displacement of the window that ends there.

    Args:
        s: the state at its start.
        interval: the interval that follows the previous one.
        displacement: predicted displacement; None if no window ends or none is available.
        fixes: fixes up to the interval's end that were not given before, in order of time.
        config: noise and filter settings.
    """
    accel_factor = s.statistics.accel_factor
    s = changed(with_step(s, interval, displacement, fixes), in_gap=interval.gap)
    if interval.gap or fixes:
        s = changed(s, alternative=None)
    s, segment, accepted, without_yaw = _propagated(s, interval, accel_factor, fixes, config)
    s, interval = _with_height(s, interval)
    before = s.ekf
    s, zero_velocity = _with_rest(s, interval, config)
    s, before = s.with_correction(before, "rest"), s.ekf
    # Zero velocity is more accurate than a network trained on walks, off by 1 cm/s at rest.
    offered = None
    if displacement is not None and zero_velocity is None:
        covariance_N = s.statistics.excess * displacement.covariance_N
        offered = displacement._replace(covariance_N=covariance_N)
    climb_rate = None if s.ekf.offset is None else s.climb_rate
    used = offered
    if offered is not None and climb_rate is not None:
        used = height.yielding(offered, climb_rate)
    s, outcome, rejected_later = _with_displacement(s, used, config)
    s, before = s.with_correction(before, "network"), s.ekf
    s = _with_ride(s, interval.stop, offered, outcome, zero_velocity)
    s, bearing = _with_bearing(s, interval)
    s = s.with_correction(before, "magnetic field")
    s, north = _with_north(s, config)
    before = s.ekf
    if config.filter.adaptive and is_due(interval, s.begun):
        P = s.ekf.P[GYRO_BIAS, GYRO_BIAS]
        prior = s.bias_prior.updated(s.ekf.b_g, P, _walked(s, config))
        s = _with_prior(s, prior, config).with_correction(before, "gyroscope's bias")
    released = s.released
    if interval.update or interval.gap:
        s = _with_clone(s)
    record = Record(
        interval,
        accel_factor,
        segment,
        offered,
        outcome,
        rejected_later,
        zero_velocity,
        bearing,
        accepted + north,
        without_yaw,
        s.estimate(),
        s.released if s.released is not released else None,
        climb_rate,
    )
    return s, record


def late_fix(
    s: EstimatorState, fix: Fix, config: NavigatorConfig
) -> tuple[EstimatorState, list[Accepted]] | None:
    """Apply a fix from the past; return None if it is more than a window late.

    The state becomes what it would be had the fix arrived in time: the filter returns to the state
    before it and repeats the steps since then with the fix in its place.

    Returns:
        The newest state, and all fixes applied since then, in order.
    """
    found = rewound(s, fix.time)
    if found is None:
        return None
    s, steps = found
    accepted = []
    for n, each in enumerate(steps):
        fixes = sorted((*each.fixes, fix), key=by_time) if n == 0 else each.fixes
        s, record = step(s, each.interval, each.displacement, fixes, config)
        accepted += record.fixes
    return s, accepted


# --- parts of a step -----------------------------------------------------------------------------


def _propagated(
    s: EstimatorState,
    interval: ImuInterval,
    accel_factor: float,
    fixes: Sequence[Fix],
    config: NavigatorConfig,
) -> tuple[EstimatorState, Segment | None, list[Accepted], list[Fix]]:
    """Propagate through the fixes and, after a gap, level the attitude.

    Return the segment (None for a gap, and if fixes split it), the fixes applied, and those refused
    for want of a direction, too.
    """
    if interval.gap:
        for slot in s.ekf.clone_slots:  # no displacement spans a gap
            s = changed(s, ekf=ekf.release(s.ekf, slot))
        if interval.duration > INTERPOLATED:
            # Nothing links them to the track after it, which they would seem to place.
            s = s.counted("fixes", *["in a long gap"] * len(fixes))
            fixes = ()
    if interval.lost:
        s = changed(s, ekf=state_after_loss(s.ekf, interval, config))
        return _with_yaw_lost(s), None, [], []
    segment: Segment | None = None
    accepted: list[Accepted] = []
    without_yaw: list[Fix] = []
    pieces = split_at_fixes(interval, fixes)
    for piece, due in pieces:
        if piece is not None and interval.gap:
            s = changed(s, ekf=ekf.propagate_in_gap(s.ekf, piece, interval, config))
            s = _with_yaw_lost(s)
        elif piece is not None:
            s, segment = _integrated(s, piece, interval, accel_factor, config)
        for fix in due:
            s, result = _with_fix(s, fix, config)
            if result.accepted:
                accepted.append(Accepted(fix, result.scale))
            elif result.reason == map_frame.YAW_UNKNOWN:
                without_yaw.append(fix)
    if interval.flags.missed:
        s = s.both(with_velocity_bounded)
    if interval.levelled is not None:
        sigma = tilt_sigma(interval.levelled, config)
        levelled, _ = ekf.update_tilt(s.ekf, interval.levelled.up_B, sigma)
        s = changed(s, ekf=levelled)
    return s, (segment if len(pieces) == 1 else None), accepted, without_yaw


def _with_yaw_lost(s: EstimatorState) -> EstimatorState:
    return changed(s, map_frame=map_frame.after_gap(Mapped(s.ekf, s.map_frame)))


def _integrated(
    s: EstimatorState,
    piece: ImuInterval,
    interval: ImuInterval,
    accel_factor: float,
    config: NavigatorConfig,
) -> tuple[EstimatorState, Segment]:
    """Propagate through a piece of an interval; return the filter's segment, too."""
    # The noise of faulty samples is what it may be.
    correlated = config.filter.correlated_errors
    accel_share = ACCEL_SHARE if correlated and not any(interval.flags) else 1.0
    segments = []

    def propagated(state: EkfState) -> EkfState:
        segment = segment_of([piece], [accel_factor], state.b_g, state.b_a, config)
        segments.append(segment)
        return ekf.propagate(state, segment, accel_share)

    return s.both(propagated), segments[0]


def _with_fix(
    s: EstimatorState, fix: Fix, config: NavigatorConfig
) -> tuple[EstimatorState, UpdateResult]:
    (state, frame), result = map_frame.update_with(fix, Mapped(s.ekf, s.map_frame), config.filter)
    s = changed(s, ekf=state, map_frame=frame).counted("fixes", *result.outcomes)
    return s, result


def _with_height(s: EstimatorState, interval: ImuInterval) -> tuple[EstimatorState, ImuInterval]:
    """Update with the height by the pressure, and note whether it climbs and the air stepped."""
    sample = interval.height
    if sample is None:
        return (changed(s, climb_rate=UNKNOWN_RATE) if height.silent(s.ekf) else s), interval
    sample = height.with_step(s.ekf, sample)
    after, result = height.with_height(s.ekf, sample)
    if s.alternative is not None:
        other, _ = height.with_height(s.alternative.ekf, sample)
        s = changed(s, alternative=changed(s.alternative, ekf=other))
    s = changed(s, ekf=after, climb_rate=sample.rate)
    steps = ["steps"] if sample.stepped else []
    return s.counted("pressures", *result.outcomes, *steps), changed(interval, height=sample)


def _with_rest(
    s: EstimatorState, interval: ImuInterval, config: NavigatorConfig
) -> tuple[EstimatorState, ZeroVelocity | None]:
    """Update if the second that ends with an interval was still."""
    s = changed(s, stillness=s.stillness.after(interval, config.filter))
    if not s.stillness.rested:
        return s, None
    measured = s.stillness.measurement()
    used = height.resting_in_lift(measured) if s.climb_rate else measured
    state, result = update_zero_velocity(s.ekf, used, config.filter)
    s = changed(s, ekf=state).counted("zero_velocity", *result.outcomes)
    if not result.accepted:
        return s, None
    return changed(s, alternative=None), measured


def _with_displacement(
    s: EstimatorState, displacement: WindowDisplacement | None, config: NavigatorConfig
) -> tuple[EstimatorState, UpdateResult | None, tuple[float, ...]]:
    """Update with a displacement; return the outcome and the times of earlier false ones, too."""
    if displacement is None:
        return s, None, ()
    after, statistics, result, rejected_later = displacements.update_with(
        displacement, s.hypotheses, s.statistics, config.filter
    )
    s = changed(s, statistics=statistics, counts=s.counts.add_displacement(result))
    return s.with_hypotheses(after), result, rejected_later


def _with_ride(
    s: EstimatorState,
    stop: float,
    offered: WindowDisplacement | None,
    outcome: UpdateResult | None,
    zero_velocity: ZeroVelocity | None,
) -> EstimatorState:
    """Note whether the device may ride in a vehicle."""
    if zero_velocity is not None:
        return changed(s, ride=s.ride.at_rest(stop))
    return changed(s, ride=s.ride.after(stop, offered, outcome))


def _with_bearing(s: EstimatorState, interval: ImuInterval) -> tuple[EstimatorState, Gained | None]:
    """Update with the magnetic field; return what it told about attitude and bias, too."""
    m_B, reference, before = interval.field_B, s.magnetic, s.ekf
    if interval.field_anew and not reference.held:
        s = _with_field_anew(s, magnetic.MagneticReference())
        reference, before = s.magnetic, s.ekf
    if m_B is None or not reference.is_due(interval.stop, before):
        return s, None
    m_B = m_B - reference.offset_B
    after, result, updated = magnetic.update_bearing(before, reference, m_B)
    if updated.rotation.is_uncalibrated:
        return _with_field_anew(s, updated.calibrated()), None
    if s.alternative is not None:
        other, *_ = magnetic.update_bearing(s.alternative.ekf, reference, m_B)
        s = changed(s, alternative=changed(s.alternative, ekf=other))
    updated = changed(updated, pose=(after.R_WB, after.p_W))
    s = changed(s, ekf=after, magnetic=updated).counted("bearings", *result.outcomes)
    return s, gained_information(before, after)


def _with_field_anew(s: EstimatorState, reference: magnetic.MagneticReference) -> EstimatorState:
    """Begin with the field anew: what it told has another hard iron."""
    return changed(s.both(magnetic.without_field), magnetic=reference)


def _with_north(
    s: EstimatorState, config: NavigatorConfig
) -> tuple[EstimatorState, list[Accepted]]:
    """Apply the yaw from magnetic north once, if a declination is set and yaw is unknown."""
    declination = config.filter.declination
    if declination is None or s.map_frame.yaw_known:
        return s, []
    fix = magnetic.north_fix(s.ekf, s.magnetic, declination)
    if fix is None:
        return s, []
    (state, frame), result = map_frame.update_with(fix, Mapped(s.ekf, s.map_frame), config.filter)
    s = changed(s, ekf=state, map_frame=frame)
    if not result.accepted:
        return s, []
    # The alternative is in the old frame.
    return changed(s, alternative=None).counted("bearings", "north"), [Accepted(fix, result.scale)]


def _with_prior(s: EstimatorState, prior: GyroBiasPrior, config: NavigatorConfig) -> EstimatorState:
    """Replace the bias's prior in both filters as if it had been used from the start."""
    walked = _walked(s, config)
    old, new = s.bias_prior.variance + walked, prior.variance + walked
    return changed(s.both(lambda state: with_prior_replaced(state, old, new)), bias_prior=prior)


def _walked(s: EstimatorState, config: NavigatorConfig) -> float:
    """Return the variance by which the gyroscope's bias may have changed since the start."""
    return float(config.noise.gyro_walk**2 * max(0.0, s.time - s.begun))


def _with_clone(s: EstimatorState) -> EstimatorState:
    """Copy the current pose, if all slots are taken instead of the oldest clone."""
    slots, oldest = s.ekf.clone_slots, None
    if len(slots) == len(s.ekf.clone_times):
        oldest = slots[0]
        released = s.ekf.clone_estimate(oldest, len(s.map_frame.transforms))
        s = changed(s, released=s.with_way(released))
    return s.both(lambda state: ekf.clone(state, oldest).with_lost_yaw_forgotten())
