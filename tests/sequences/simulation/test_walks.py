from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import welch

from stario.sequences import PERFECT_IMU, STANDARD_GRAVITY, Trajectory, about_z, simulate_imu
from stario.sequences.simulation.carrying import CARRYING_MODES
from stario.sequences.simulation.insertion import insert_moment
from stario.sequences.simulation.moments import MOMENTS
from stario.sequences.simulation.routes import Route, band_noise, drift, random_route
from stario.sequences.simulation.strides import stride_cycles
from stario.sequences.simulation.walks import WalkStyle, _gait, generate_walk


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


@pytest.mark.parametrize("seed", [5, 14, 17, 21])  # of trolleys, if they are drawn
def test_a_plain_walk_is_that_of_a_phone_on_a_person(seed):
    for plain, least, most in ((True, 0.01, 2.0), (False, 0.0, 0.005)):
        bounce = np.ptp(generate_walk(seed, 30.0, plain=plain).position_W[:, 2])
        assert least < bounce < most


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


def test_routes_stop_turn_climb_and_keep_to_pedestrian_speeds():
    routes = [random_route(np.random.default_rng(seed), 6000, 100.0, 1.1) for seed in range(20)]
    level = random_route(np.random.default_rng(0), 60000, 100.0, 1.1, level=True)
    assert np.ptp(level.position_W[:, 2]) < 1e-9
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
    ahead = [
        about_z(route.heading).apply(np.gradient(route.position_W, 0.01, axis=0), inverse=True)[
            :, 0
        ]
        for route in routes
    ]
    assert min(speed.min() for speed in ahead) < -0.2


def test_a_mount_changes_neither_path_nor_rotation_in_the_world():
    level, tilted = (
        generate_walk(2, 10.0, style=WalkStyle(carry="swinging", mount_rotvec=mount))
        for mount in ((0.0, 0.0, 0.0), (0.4, -0.7, 1.1))
    )
    imus = [simulate_imu(walk, 100.0, PERFECT_IMU) for walk in (level, tilted)]
    np.testing.assert_array_equal(level.position_W, tilted.position_W)
    rates = [imu.truth.attitude_WB.apply(imu.gyro) for imu in imus]
    np.testing.assert_allclose(*rates, atol=0.01)


def test_a_rig_turns_fast_and_a_trolley_neither_climbs_nor_bounces():
    peaks = []
    for seed in range(6):
        walk = generate_walk(seed, 60.0, style=WalkStyle(carry="rig"))
        gyro = simulate_imu(walk, errors=PERFECT_IMU).gyro
        peaks.append(np.degrees(np.linalg.norm(gyro, axis=1).max()))
    assert 120.0 < np.median(peaks) < 360.0
    style = WalkStyle(carry="trolley")
    rolling = generate_walk(4, 60.0, style=style)
    walking = generate_walk(4, 60.0, style=replace(style, carry="handheld"))
    assert np.ptp(rolling.position_W[:, 2]) < 0.005
    heights = np.stack([walk.position_W[:, 2] for walk in (rolling, walking)])
    f, power = welch(np.diff(heights, 2) * 1e4, 100.0, nperseg=1024)
    bounce = power[:, (f > 1.0) & (f < 3.0)].sum(axis=1)
    assert bounce[0] < 0.1 * bounce[1]


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
    route = Route(
        np.zeros((count, 3)), 0.02 * np.arange(count), np.zeros((count, 2)), still + 2, still
    )
    standing = replace(route, turn_rate=still)
    people = stride_cycles("handheld")[:1]
    turning, resting = (
        _gait(np.random.default_rng(0), 100.0, r, 1.75, people, still) for r in (route, standing)
    )
    assert turning.pace.min() > 0.5
    assert resting.pace.max() < 1e-9
    assert turning.step_rate.mean() > 1.2 * resting.step_rate.mean()


def test_a_change_of_carrying_mode_turns_the_device_as_it_is_carried_there():
    angles = []
    for seed in range(8):
        walk = generate_walk(seed, 20.0, style=WalkStyle(carry="in-front", next_carry="call"))
        up_B = walk.attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
        before, after = up_B[:400].mean(axis=0), up_B[-400:].mean(axis=0)
        cosine = before @ after / (np.linalg.norm(before) * np.linalg.norm(after))
        angles.append(np.arccos(cosine))
    assert min(angles) > 0.8  # from lying to upright
