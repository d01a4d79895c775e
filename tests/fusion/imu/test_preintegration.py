from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from se23 import exp_se23

from stario.fusion import NavigatorConfig, Segment, preintegrate
from stario.fusion.filter.jacobians import propagated
from stario.fusion.imu.faults import OutlierDetector
from stario.fusion.imu.intervals import NO_FLAGS, Flags, ImuInterval
from stario.fusion.imu.preintegration import corrected_increments, segment_of
from stario.fusion.values.lie import log_se23
from stario.sequences.attitude.so3 import exp_so3, log_so3, skew
from stario.sequences.noise import ImuNoise

GRAVITY = 9.80665
NOISE = ImuNoise(1e-3, 1e-2, 1e-4, 1e-3)


def samples(rate: float, duration: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hand-held device in lively motion, without noise."""
    t = np.linspace(0.0, duration, round(duration * rate) + 1)
    gyro = np.stack([2 * np.sin(9 * t), 1.5 * np.cos(7 * t), 1.0 + np.sin(5 * t)], axis=1)
    accel = np.stack([3 * np.cos(8 * t), 2 * np.sin(11 * t), GRAVITY + 4 * np.sin(6 * t)], axis=1)
    return t, gyro, accel


def state() -> tuple[np.ndarray, ...]:
    v_W, p_W = np.array([[1.0, -0.6, 0.2], [12.0, -7.0, 1.5]])
    b_g, b_a = np.array([[0.01, -0.02, 0.03], [0.1, 0.2, -0.15]])
    return exp_so3(np.array([0.4, -1.2, 2.0])), v_W, p_W, b_g, b_a


def moved(x: tuple[np.ndarray, ...], error: np.ndarray) -> tuple[np.ndarray, ...]:
    R, v, p = exp_se23(error[:9])
    return R @ x[0], R @ x[1] + v, R @ x[2] + p, x[3] + error[9:12], x[4] + error[12:]


def difference(x: tuple[np.ndarray, ...], y: tuple[np.ndarray, ...]) -> np.ndarray:
    R = x[0] @ y[0].T
    return np.concatenate([log_se23(R, x[1] - R @ y[1], x[2] - R @ y[2]), x[3] - y[3], x[4] - y[4]])


def coning(rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One second of coning about x at 10 Hz with a vibrating force: samples and exact end state."""
    t = np.linspace(0.0, 1.0, round(rate) + 1)

    def signals(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        phase = 2 * np.pi * 10 * t
        gyro = np.stack([0 * t, 3 * np.cos(phase), 3 * np.sin(phase)], axis=-1)
        accel = np.stack([0 * t, 20 * np.sin(phase), GRAVITY - 20 * np.cos(phase)], axis=-1)
        return gyro, accel

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        gyro, accel = signals(np.asarray(t))
        R = y[:9].reshape(3, 3)
        return np.concatenate([(R @ skew(gyro)).ravel(), R @ accel])

    y = np.r_[np.eye(3).ravel(), 0, 0, 0]
    end = solve_ivp(rates, (0, 1), y, rtol=1e-12, atol=1e-12, method="DOP853").y[:, -1]
    gyro, accel = signals(t)
    return t, gyro, accel, end[:9].reshape(3, 3), end[9:]


def integrated(dt, rate, force) -> tuple[np.ndarray, np.ndarray]:
    R, v = np.eye(3), np.zeros(3)
    for step, w, a in zip(dt, rate, force, strict=True):
        v = v + R @ a * step
        R = R @ exp_so3(w * step)
    return R, v


def interpolated(t: np.ndarray, values: np.ndarray, finer: int) -> np.ndarray:
    fine = np.linspace(t[0], t[-1], finer * (len(t) - 1) + 1)
    return np.stack([np.interp(fine, t, column) for column in values.T], axis=1)


def blow(t: np.ndarray, centre: float, seconds: float, speed: float) -> np.ndarray:
    """Force upwards (N,) of a device that stands, and is struck to a speed [m/s]."""
    phase = np.clip((t - centre) / seconds + 0.5, 0.0, 1.0)
    return GRAVITY + speed * np.pi / 2.0 / seconds * np.sin(np.pi * phase)


def test_a_segment_equals_dead_reckoning_on_fine_samples():
    R, v, p, b_g, b_a = state()
    t, gyro, accel = samples(200)
    finer = 100
    dt = 0.005 / finer
    expected_R, expected_v, expected_p = R, v, p
    w, a = interpolated(t, gyro, finer) - b_g, interpolated(t, accel, finer) - b_a
    for k in range(finer * (len(t) - 1)):
        rate, force = 0.5 * (w[k] + w[k + 1]), 0.5 * (a[k] + a[k + 1])
        a_W = expected_R @ exp_so3(0.5 * dt * rate) @ force - [0, 0, GRAVITY]
        expected_p = expected_p + expected_v * dt + 0.5 * a_W * dt * dt
        expected_v = expected_v + a_W * dt
        expected_R = expected_R @ exp_so3(rate * dt)
    for k in range(0, 100, 10):
        part = slice(k, k + 11)
        segment = preintegrate(t[part], gyro[part], accel[part], b_g, b_a, NOISE, GRAVITY)
        assert segment.duration == pytest.approx(0.05)
        R, v, p = segment.predict(R, v, p, b_g, b_a)
    np.testing.assert_allclose(log_so3(R @ expected_R.T), 0.0, atol=1e-5)
    np.testing.assert_allclose(v, expected_v, atol=5e-5)
    np.testing.assert_allclose(p, expected_p, atol=5e-5)


def test_coning_and_sculling_corrections_beat_the_midpoint_rule():
    t, gyro, accel, R_true, v_true = coning(200)
    corrected = corrected_increments(t, gyro, accel)
    midpoint = np.diff(t), 0.5 * (gyro[1:] + gyro[:-1]), 0.5 * (accel[1:] + accel[:-1])

    def errors(increments, R_ref, v_ref):
        R, v = integrated(*increments)
        return np.array([np.linalg.norm(log_so3(R @ R_ref.T)), np.linalg.norm(v - v_ref)])

    # Against the true motion, which bends between samples, and against straight lines between them.
    assert (errors(corrected, R_true, v_true) < 0.6 * errors(midpoint, R_true, v_true)).all()
    fine = np.linspace(0.0, 1.0, 10_001), interpolated(t, gyro, 50), interpolated(t, accel, 50)
    lines = integrated(*corrected_increments(*fine))
    assert (errors(corrected, *lines) < 0.02 * errors(midpoint, *lines)).all()


def test_transition_agrees_with_finite_differences():
    x = state()
    segment = preintegrate(*samples(200, 0.1), x[3], x[4], NOISE, GRAVITY)

    def across(y):
        return (*segment.predict(*y), y[3], y[4])

    end, step = across(x), 1e-6
    numeric = np.empty((15, 15))
    for k, d in enumerate(step * np.eye(15)):
        plus, minus = across(moved(x, d)), across(moved(x, -d))
        numeric[:, k] = (difference(plus, end) - difference(minus, end)) / (2 * step)
    np.testing.assert_allclose(propagated(segment, *x).transition, numeric, atol=1e-6)


def test_noise_agrees_with_that_of_perturbed_samples():
    """Sum over each sample's noise and each step of the biases' walks, by finite differences."""
    R, v, p, b_g, b_a = state()
    n, dt = 10, 0.02
    t, gyro, accel = samples(1 / dt, n * dt)
    step = 1e-5
    # Perturbed after the corrections for rotation, so that each sample acts on one interval.
    dt_k, rate, force = corrected_increments(t, gyro - b_g, accel - b_a)

    def end(w, a):
        y_R, y_v, y_p = R, v, p
        for k in range(n):
            a_W = y_R @ a[k] - [0, 0, GRAVITY]
            y_p = y_p + y_v * dt_k[k] + 0.5 * a_W * dt_k[k] ** 2
            y_v = y_v + a_W * dt_k[k]
            y_R = y_R @ exp_so3(w[k] * dt_k[k])
        return y_R, y_v, y_p, np.zeros(3), np.zeros(3)

    reference = end(rate, force)
    expected = np.zeros((15, 15))
    for k in range(n):
        for axis in range(3):
            for which in range(4):  # gyro noise, accel noise, gyro walk, accel walk
                w, a = rate.copy(), force.copy()
                signal = w if which in (0, 2) else a
                signal[slice(k, k + 1) if which < 2 else slice(k + 1, n), axis] -= step
                column = difference(end(w, a), reference) / step
                density = (NOISE.gyro_noise, NOISE.accel_noise, NOISE.gyro_walk, NOISE.accel_walk)
                sigma = density[which] * (dt**-0.5 if which < 2 else dt**0.5)
                if which >= 2:
                    column[(9 if which == 2 else 12) + axis] = 1.0
                expected += np.outer(column, column) * sigma**2
    segment = preintegrate(t, gyro, accel, b_g, b_a, NOISE, GRAVITY)
    noise = propagated(segment, R, v, p, b_g, b_a).noise[0]
    sigma = np.sqrt(np.diag(expected))
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(noise / scale, expected / scale, atol=1e-3)


def test_an_impact_between_samples_is_as_uncertain_as_the_force_changes():
    """A blow of 12 ms and 3 m/s, sampled at 100 Hz, which meets its peak or its flanks."""
    t = np.linspace(0.0, 0.1, 11)
    errors, sigmas = [], []
    for centre in np.linspace(0.045, 0.055, 21):
        segment = standing(t, blow(t, centre, 0.012, 3.0))
        velocity = segment.predict(np.eye(3), *np.zeros((4, 3)))[1][2]
        errors.append(velocity - 3.0)
        sigmas.append(np.sqrt(segment.pim.preintMeasCov()[8, 8]))
    assert np.max(np.abs(errors)) > 0.5
    assert (np.abs(errors) < 2.0 * np.array(sigmas)).all()


@pytest.mark.parametrize("rate", [200.0, 400.0])
def test_what_a_sensor_missed_at_its_limit_is_within_its_sigma(rate):
    """A phone on a floor: 6 m/s within 20 ms, of which an accelerometer of 8 g measures a fifth."""
    t, limit = np.arange(0.0, 0.1 + 0.5 / rate, 1.0 / rate), 8.0 * GRAVITY
    for centre in np.linspace(0.045, 0.055, 11):
        force = np.minimum(blow(t, centre, 0.02, 6.0), limit)
        flags = OutlierDetector().detect(table_of(t, force))
        segment = standing(t, force, flags)
        velocity = segment.predict(np.eye(3), *np.zeros((4, 3)))[1][2]
        assert abs(velocity - 6.0) > 4.0
        sigma = np.sqrt(segment.pim.preintMeasCov()[8, 8])
        assert abs(velocity - 6.0) < 3.0 * sigma < 15.0


def test_a_walking_force_is_as_certain_as_its_density():
    t = np.linspace(0.0, 0.1, 11)
    force = GRAVITY + 4.0 * np.sin(2.0 * np.pi * 2.0 * t)
    variance = standing(t, force).pim.preintMeasCov()[8, 8]
    assert variance == pytest.approx(0.1 * NavigatorConfig().noise.accel_noise ** 2, rel=0.05)


def table_of(time: np.ndarray, force: np.ndarray) -> np.ndarray:
    return np.column_stack([time, np.zeros((len(time), 5)), force])


def standing(time: np.ndarray, force: np.ndarray, flags: Flags = NO_FLAGS) -> Segment:
    interval = ImuInterval(table_of(time, force), np.eye(3), flags=flags)
    return segment_of([interval], [1.0], np.zeros(3), np.zeros(3), NavigatorConfig())


def test_a_segment_with_noise_per_sample_equals_its_parts_in_sequence():
    """An impact's velocity error acts on the position afterwards, which mean noise would miss."""
    x = state()
    t, gyro, accel = samples(200)
    loud = [replace(NOISE, accel_noise=size * NOISE.accel_noise) for size in (8.0, 1.0, 1.0, 4.0)]
    parts, step = [], (len(t) - 1) // 4
    transition, noise, y = np.eye(15), np.zeros((15, 15)), x[:3]
    for k, density in enumerate(loud):
        part = slice(k * step, (k + 1) * step + 1)
        segment = preintegrate(t[part], gyro[part], accel[part], *x[3:], density, GRAVITY)
        ahead = propagated(segment, *y, *x[3:])
        transition = ahead.transition @ transition
        noise = ahead.transition @ noise @ ahead.transition.T + ahead.noise[0]
        y = ahead[:3]
        parts += [density] * step
    whole = propagated(preintegrate(t, gyro, accel, *x[3:], parts, GRAVITY), *x)
    np.testing.assert_allclose(whole.transition, transition, atol=1e-2)
    sigma = np.sqrt(noise.diagonal())
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(whole.noise[0] / scale, noise / scale, atol=2e-3)
    mean = replace(NOISE, accel_noise=NOISE.accel_noise * np.sqrt(np.mean([64, 1, 1, 16])))
    other = propagated(preintegrate(t, gyro, accel, *x[3:], mean, GRAVITY), *x).noise[0]
    assert other[6, 6] < 0.8 * noise[6, 6]


@pytest.mark.parametrize("turn", [2.0 * np.pi, 11.0])
def test_more_than_a_full_turn_in_a_segment_leaves_its_jacobians_bounded(turn):
    # As of a gyroscope in deg/s, before the stream is refused.
    time = np.linspace(0.0, 0.1, 11)
    gyro, accel = np.tile([0.0, 0.0, turn / 0.1], (11, 1)), np.tile([0.0, 0.0, 9.81], (11, 1))
    segment = preintegrate(time, gyro, accel, np.zeros(3), np.zeros(3), NOISE, 9.81)
    end = propagated(segment, np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    assert np.abs(end.transition).max() < 10.0
    assert np.abs(end.noise).max() < 100.0
    assert end.noise[0][2, 2] > 1.0  # the yaw is not known any more [rad^2]


def test_propagation_keeps_yaw_and_position_unobservable():
    x = state()
    segment = preintegrate(*samples(200), x[3], x[4], NOISE, GRAVITY)
    unobservable = np.zeros((15, 4))
    unobservable[2, 0] = 1.0
    unobservable[6:9, 1:] = np.eye(3)
    kept = propagated(segment, *x).transition @ unobservable
    np.testing.assert_allclose(kept, unobservable, rtol=0.0, atol=1e-10)
