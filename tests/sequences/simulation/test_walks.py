from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert, welch

from stario.sequences.attitude.rotations import about_z
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY, Trajectory
from stario.sequences.simulation.gait import Gait, Strike, heel_strikes, trunk
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.insertion import insert_moment
from stario.sequences.simulation.moments import MOMENTS
from stario.sequences.simulation.routes import Route, band_noise, drift, random_route
from stario.sequences.simulation.walks import (
    CARRYING_MODES,
    WalkStyle,
    _gait,
    generate_walk,
    step_rate,
)


@pytest.mark.parametrize("carry", CARRYING_MODES)
def test_every_carrying_mode_is_plausible(carry):
    for seed in range(3):
        style = replace(WalkStyle.random(np.random.default_rng(seed)), carry=carry, next_carry="")
        imu = simulate_imu(generate_walk(seed, 30.0, style=style), errors=PERFECT_IMU)
        force, turning = np.linalg.norm(imu.accel, axis=1), np.linalg.norm(imu.gyro, axis=1)
        assert np.isfinite(imu.accel).all()
        assert force.max() < 6.0 * STANDARD_GRAVITY
        assert turning.max() < 20.0
        upward = imu.truth.attitude_WB.apply(np.array(imu.accel))[:, 2].mean()
        assert upward == pytest.approx(STANDARD_GRAVITY, abs=0.15)


def test_a_hundred_walks_cover_the_styles():
    styles = [WalkStyle.random(np.random.default_rng(seed)) for seed in range(100)]
    assert {style.carry for style in styles} == set(CARRYING_MODES)
    assert 10 < sum(bool(style.next_carry) for style in styles) < 60


TRACK = generate_walk(3, 20.0)
SIMULATED = {
    "walk": lambda seed: simulate_imu(generate_walk(seed, 10.0), errors=PERFECT_IMU),
    "errors": lambda seed: simulate_imu(TRACK, seed=seed),
    "moment": lambda seed: (
        insert_moment(simulate_imu(TRACK), TRACK, MOMENTS[0], 0.5, seed).sequence
    ),
}


@pytest.mark.parametrize("simulate", SIMULATED.values(), ids=SIMULATED)
def test_a_seed_reproduces_and_another_differs(simulate):
    first, again, other = (simulate(seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.gyro, again.gyro)
    np.testing.assert_array_equal(first.accel, again.accel)
    assert len(first) != len(other) or not np.allclose(first.accel, other.accel)


def test_step_rate_and_step_length_grow_together_with_speed():
    style = WalkStyle(height=1.75)
    speed = np.array([0.5, 1.0, 1.4, 2.0])
    rate = step_rate(speed, style)
    assert (np.diff(rate) > 0.0).all()
    assert (np.diff(speed / rate) > 0.0).all()
    # Measured on people with phones: 1.5, 1.75 to 1.85, 1.95 to 2.0 and 2.2 steps per second.
    np.testing.assert_allclose(rate, [1.45, 1.78, 1.96, 2.18], atol=0.06)
    tall, short = replace(style, height=1.95), replace(style, height=1.55)
    assert (step_rate(speed, tall) < step_rate(speed, short)).all()


@pytest.mark.parametrize("speed", [0.7, 1.1, 1.5])
def test_the_device_bounces_at_the_step_rate_of_its_speed(speed):
    """Over several walks the strongest vertical spectral line lies at the step rate."""
    style = WalkStyle(carry="bag", preferred_speed=speed, vigor=0.5)
    found, expected = [], []
    for seed in range(4):
        walk = generate_walk(seed, 60.0, style=style)
        found += list(_bounce_rates(walk))
        expected += list(step_rate(_window_speeds(walk), style))
    walking = np.array(expected) > step_rate(np.array([0.5]), style)[0]
    ratio = np.array(found)[walking] / np.array(expected)[walking]
    assert walking.sum() > 20
    assert np.median(ratio) == pytest.approx(1.0, abs=0.08)


def _windows(walk: Trajectory) -> list[slice]:
    return [slice(k, k + 400) for k in range(0, len(walk) - 400, 400)]


def _window_speeds(walk: Trajectory) -> np.ndarray:
    velocity = np.gradient(walk.position_W[:, :2], walk.time, axis=0)
    smooth = np.stack([np.convolve(v, np.ones(100) / 100, mode="same") for v in velocity.T], axis=1)
    return np.array([np.linalg.norm(smooth[w], axis=1).mean() for w in _windows(walk)])


def _bounce_rates(walk: Trajectory) -> np.ndarray:
    upward = np.gradient(np.gradient(walk.position_W[:, 2], walk.time), walk.time)
    rates = []
    for w in _windows(walk):
        f, power = welch(upward[w], 100.0, nperseg=400, nfft=4096)
        band = (f > 0.7) & (f < 2.6)
        rates.append(f[band][np.argmax(power[band])])
    return np.array(rates)


def test_routes_stop_turn_climb_and_keep_to_pedestrian_speeds():
    routes = [random_route(np.random.default_rng(seed), 6000, 100.0, 1.1) for seed in range(20)]
    speed = np.concatenate([route.speed for route in routes])
    turning = np.concatenate([np.abs(route.turn_rate) for route in routes])
    assert speed.max() < 2.25
    assert 0.02 < (speed < 0.05).mean() < 0.3
    assert ((speed < 0.1) & (turning > 0.7)).any()
    assert turning.max() > 1.5
    heights = [np.ptp(route.position_W[:, 2]) for route in routes]
    assert max(heights) > 1.5
    assert min(heights) == pytest.approx(0.0, abs=1e-9)
    climb = np.abs(np.concatenate([route.climb for route in routes]))
    on_stairs = climb > 0.8 * climb.max()
    slope = climb[on_stairs] / speed[on_stairs]
    assert np.median(slope) == pytest.approx(0.17 / 0.29, rel=0.02)
    backward = [_forward_speed_is_negative(route.position_W, route.heading) for route in routes]
    assert any(backward)


def _forward_speed_is_negative(position: np.ndarray, heading: np.ndarray) -> bool:
    velocity = about_z(heading).apply(np.gradient(position, 0.01, axis=0), inverse=True)
    return bool((velocity[:, 0] < -0.2).any())


def test_a_trolley_neither_climbs_nor_bounces():
    style = WalkStyle(carry="trolley")
    rolling = generate_walk(4, 60.0, style=style)
    walking = generate_walk(4, 60.0, style=replace(style, carry="handheld"))
    assert np.ptp(rolling.position_W[:, 2]) < 0.005
    bounce = [np.diff(walk.position_W[:, 2], 2).std() for walk in (rolling, walking)]
    assert _low_band(rolling) < 0.1 * _low_band(walking), bounce


def _low_band(walk: Trajectory) -> float:
    f, power = welch(np.diff(walk.position_W[:, 2], 2) * 1e4, 100.0, nperseg=1024)
    return float(power[(f > 1.0) & (f < 3.0)].sum())


_BLOW = Strike(1.0, 7.0, 0.3, (0.6, 90.0), 0.5, (0.3, 60.0), (0.2, 30.0), (0.4, -60.0), 0.0)


def test_what_heel_strikes_excite_has_the_size_and_lead_that_were_measured():
    time, one = np.arange(2000) / 200.0, np.ones(2000)
    phase = 2.0 * np.pi * 1.8 * time
    found = []
    for seed in range(20):
        gait = Gait(np.random.default_rng(seed), 200.0, phase, 1.8 * one, one, one, 1.75, 1.0)
        ring = heel_strikes(gait, _BLOW)
        rates = np.gradient(ring.turn_H, time, axis=0)
        forces = np.gradient(np.gradient(ring.offset_H, time, axis=0), time, axis=0)
        x, y, z, about_x, about_y, about_z = hilbert(np.hstack([forces, rates])[100:-100], axis=0).T
        pairs = ((x, z), (about_x, y), (about_y, z), (about_z, y))
        found.append([np.vdot(b, a) / np.vdot(b, b) for a, b in pairs])
        assert np.std(z.real) == pytest.approx(1.0, rel=0.25)
    mean = np.mean(found, axis=0)
    np.testing.assert_allclose(np.degrees(np.angle(mean)), [90.0, 60.0, 30.0, -60.0], atol=15.0)
    # Each harmonic strays, so that the coherent part is smaller than the whole.
    assert ((np.abs(mean) > [0.35, 0.1, 0.1, 0.15]) & (np.abs(mean) < [0.6, 0.3, 0.2, 0.4])).all()


@pytest.mark.parametrize("seed", range(3))
def test_heel_strikes_and_surge_have_the_phases_of_people(seed):
    """The trunk is slowest where it is highest, and over the standing leg there; the device rings
    once the other leg is loaded."""
    time, one = np.arange(2000) / 200.0, np.ones(2000)
    phase = 2.0 * np.pi * 1.8 * time
    gait = Gait(np.random.default_rng(seed), 200.0, phase, 1.8 * one, one, 1.3 * one, 1.75, 1.0)
    body = trunk(gait, 2.0, 1.0)
    assert np.corrcoef(np.gradient(body[:, 0], time), body[:, 2])[0, 1] < -0.7
    assert np.corrcoef(body[:, 1] ** 2, np.cos(phase))[0, 1] > 0.8
    calm = trunk(replace(gait, rng=np.random.default_rng(seed), effort=0.3 * one), 2.0, 1.0)
    forward, side, up = calm.std(axis=0) / body.std(axis=0)
    assert up < 0.35 < 0.5 < min(forward, side) < 1.0
    strike = heel_strikes(gait, _BLOW)
    ring = np.gradient(np.gradient(strike.offset_H[:, 2], time), time) ** 2
    after_strike = np.mod(phase - np.pi - 0.9, 2.0 * np.pi) < np.pi
    assert ring[after_strike].mean() > 2.0 * ring[~after_strike].mean()


def test_a_mount_changes_neither_path_nor_rotation_in_the_world():
    rates, paths = [], []
    for mount in ((0.0, 0.0, 0.0), (0.4, -0.7, 1.1)):
        walk = generate_walk(2, 10.0, style=WalkStyle(carry="swinging", mount_rotvec=mount))
        imu = simulate_imu(walk, 100.0, PERFECT_IMU)
        rates.append(imu.truth.attitude_WB.apply(imu.gyro))
        paths.append(walk.position_W)
    np.testing.assert_array_equal(*paths)
    np.testing.assert_allclose(*rates, atol=0.01)


def test_a_rig_turns_fast():
    peaks = []
    for seed in range(6):
        walk = generate_walk(seed, 60.0, style=WalkStyle(carry="rig"))
        gyro = simulate_imu(walk, errors=PERFECT_IMU).gyro
        peaks.append(np.degrees(np.linalg.norm(gyro, axis=1).max()))
    assert 120.0 < np.median(peaks) < 360.0


def test_walks_are_smooth_enough_for_the_spline():
    """The same walk interpolated from every second pose gives nearly the same samples."""
    for carry in CARRYING_MODES:
        fine = generate_walk(9, 20.0, rate=200.0, style=WalkStyle(carry=carry))
        coarse = Trajectory(fine.time[::2], fine.position_W[::2], fine.attitude_WB[::2])
        a = simulate_imu(fine, errors=PERFECT_IMU)
        b = simulate_imu(coarse, errors=PERFECT_IMU)
        inner = slice(100, -100)
        assert (a.accel - b.accel)[inner].std() < 0.1 * a.accel[inner].std()
        assert (a.gyro - b.gyro)[inner].std() < 0.1 * a.gyro[inner].std()


def test_noise_has_unit_deviation_in_its_band():
    rng = np.random.default_rng(0)
    assert drift(rng, 200_000, 100.0, 0.5).std() == pytest.approx(1.0, rel=0.05)
    noise = band_noise(rng, 100_000, 100.0, 5.0, 10.0, 2)
    assert noise.std() == pytest.approx(1.0, rel=0.05)
    f, power = welch(noise[:, 0], 100.0, nperseg=1024)
    assert power[(f > 4.0) & (f < 11.0)].sum() > 0.7 * power.sum()


def test_turning_on_the_spot_takes_steps():
    count, still = 500, np.zeros(500)
    route = Route(np.zeros((count, 3)), 0.02 * np.arange(count), still, still + 2.0, still)
    standing = replace(route, turn_rate=still)
    turning, resting = (
        _gait(np.random.default_rng(0), 100.0, r, WalkStyle()) for r in (route, standing)
    )
    assert turning.effort.min() > 0.3
    assert resting.effort.max() < 1e-9
    assert turning.step_rate.mean() > 1.2 * resting.step_rate.mean()


def test_a_change_of_carrying_mode_turns_the_device_in_the_hand():
    angles = []
    for seed in range(8):
        walk = generate_walk(seed, 20.0, style=WalkStyle(carry="bag", next_carry="bag"))
        up_B = walk.attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
        before, after = up_B[:400].mean(axis=0), up_B[-400:].mean(axis=0)
        cosine = before @ after / (np.linalg.norm(before) * np.linalg.norm(after))
        angles.append(np.arccos(cosine))
    assert np.median(angles) > 0.3


def test_styles_and_arguments_are_checked():
    with pytest.raises(InputError, match="carry"):
        WalkStyle(carry="on a hat")
    with pytest.raises(InputError, match="height"):
        WalkStyle(height=17.5)
    with pytest.raises(InputError, match="mount_rotvec"):
        WalkStyle(mount_rotvec=(0.0, 0.0, float("nan")))
    with pytest.raises(InputError, match="duration"):
        generate_walk(0, duration=0.0)
    with pytest.raises(InputError, match="rate"):
        generate_walk(0, rate=10.0)
