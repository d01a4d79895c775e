from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import PERFECT_IMU, Trajectory, measured_stride, on_one_side, simulate_imu
from stario.sequences.simulation import strides
from stario.sequences.simulation.carrying import PLACES, carry_motion
from stario.sequences.simulation.routes import Command, route_along
from stario.sequences.simulation.strides import (
    Gait,
    StrideCycle,
    drawn_cycle,
    on_other_side,
    step_rate,
    stride_cycles,
    stride_motion,
)
from stario.sequences.simulation.walks import WalkStyle, carried_along, generate_walk

RATE, COUNT = 200.0, 4000


def walking(person: StrideCycle, pace: float, seed: int = 0) -> Gait:
    """A person who walks ahead at a constant pace [m/s]."""
    one = np.ones(COUNT)
    steps = float(step_rate(person, np.array([max(pace, 0.2)]))[0])
    return Gait(
        rng=np.random.default_rng(seed),
        rate=RATE,
        phase=np.pi * steps * np.arange(COUNT) / RATE,
        step_rate=steps * one,
        pace=pace * one,
        speed=pace * one,
        course=np.tile([1.0, 0.0], (COUNT, 1)),
        height=1.75,
    )


def moved(gait: Gait, person: StrideCycle) -> np.ndarray:
    """Acceleration [m/s^2] and angular rate [rad/s] (N, 6) of a device that moves so."""
    motion = stride_motion(gait, person)
    velocity = np.gradient(motion.offset_H, 1.0 / RATE, axis=0)
    return np.hstack([np.gradient(each, 1.0 / RATE, axis=0) for each in (velocity, motion.turn_H)])[
        200:-200
    ]


def amplitudes(motion: np.ndarray, gait: Gait, harmonics: int) -> np.ndarray:
    waves = np.exp(1j * np.outer(gait.phase[200:-200], np.arange(1, harmonics + 1)))
    fitted = np.linalg.lstsq(np.hstack([waves.real, waves.imag]), motion, rcond=None)[0]
    return fitted[:harmonics] - 1j * fitted[harmonics:]


@pytest.mark.parametrize("way", PLACES)
def test_a_device_moves_as_with_the_recorded_person(way, monkeypatch):
    monkeypatch.setattr(strides, "WANDERING", 0.0)
    person = stride_cycles(way)[0]
    gait = walking(person, person.speed)
    found, known = amplitudes(moved(gait, person), gait, 8), person.amplitude[:8]
    # Differences over 5 ms take away up to a fifteenth at 8 harmonics.
    assert np.linalg.norm(found - known) < 0.06 * np.linalg.norm(known)


def test_strides_differ_more_from_each_other_the_faster_the_harmonic():
    person = stride_cycles("handheld")[0]
    shares = []
    for seed in range(6):
        gait = walking(person, person.speed, seed)
        motion = moved(gait, person)
        fits = amplitudes(motion, gait, strides.HARMONICS)
        waves = np.exp(1j * np.outer(gait.phase[200:-200], np.arange(1, len(fits) + 1)))
        rest = motion - (waves @ fits).real
        f = np.fft.rfftfreq(len(motion), 1.0 / RATE)
        power, whole = (np.abs(np.fft.rfft(x[:, :3], axis=0)) ** 2 for x in (rest, motion))
        bands = [(f > low) & (f < high) for low, high in ((1.5, 3.0), (6.0, 10.0), (10.0, 20.0))]
        shares.append([np.sqrt(power[k].sum() / whole[k].sum()) for k in bands])
    steps, middle, fast = np.mean(shares, axis=0)
    assert 0.1 < steps < 0.35 < middle < fast < 0.85


@pytest.mark.parametrize(("way", "sides"), [("pocket", {-1.0, 1.0}), ("in-front", {1.0})])
def test_a_pocket_is_on_either_side_of_the_body(way, sides):
    person = stride_cycles(way)[0]
    motions = [carry_motion(walking(person, 1.0, seed), way, person) for seed in range(12)]
    rolls = [np.gradient(each.turn_H[:, 0]) for each in motions]
    assert {np.sign(np.dot(rolls[0], each)) for each in rolls} == sides


@pytest.mark.parametrize("way", PLACES)
def test_a_device_on_the_other_side_is_a_device_and_its_other_side_the_first(way):
    for person in stride_cycles(way):
        other = on_other_side(person)
        R_HB, R_HO = (Rotation.from_quat(each.quat_xyzw).as_matrix() for each in (person, other))
        # A screen that faces the body still does, and what pointed ahead or up still does.
        mirror = np.diag([1.0, -1.0, 1.0])
        np.testing.assert_allclose(R_HO[:, 1:], mirror @ R_HB[:, 1:], atol=1e-6)
        again = on_other_side(other)
        np.testing.assert_array_equal(again.amplitude, person.amplitude)
        assert abs(again.quat_xyzw @ person.quat_xyzw) == pytest.approx(1.0, abs=1e-6)


def test_phones_are_held_as_people_hold_them():
    """In a hand in front, its upper edge ahead or up; at the ear its screen to the head."""
    for way in ("handheld", "in-front", "texting"):
        for person in stride_cycles(way):
            x_H, y_H, _ = Rotation.from_quat(person.quat_xyzw).as_matrix().T
            assert y_H @ [1.0, 0.0, 1.0] > 0.9
            assert x_H[1] < -0.6
    for person in stride_cycles("call"):
        z_H = Rotation.from_quat(person.quat_xyzw).as_matrix()[:, 2]
        assert abs(z_H[1]) > 0.8


def test_who_walks_sideways_moves_along_the_way_as_one_who_walks_ahead():
    person = stride_cycles("handheld")[0]
    ahead = walking(person, 0.6)
    left = replace(walking(person, 0.6), course=np.tile([0.0, 1.0], (COUNT, 1)))
    forward, sideways = stride_motion(ahead, person), stride_motion(left, person)
    np.testing.assert_allclose(sideways.offset_H[:, 1], forward.offset_H[:, 0], atol=1e-12)
    np.testing.assert_allclose(sideways.turn_H[:, 0], -forward.turn_H[:, 1], atol=1e-12)
    np.testing.assert_allclose(sideways.offset_H[:, 2], forward.offset_H[:, 2], atol=1e-12)


def test_faster_walks_are_bouncier_and_who_stands_has_no_stride():
    person = stride_cycles("in-front")[0]
    slow, brisk = (moved(walking(person, pace), person).std(axis=0) for pace in (0.7, 1.4))
    assert 3.0 < brisk[2] / slow[2] < 4.1
    assert 1.1 < brisk[1] / slow[1] < brisk[2] / slow[2]
    assert not moved(walking(person, 0.0), person).any()
    standing = generate_walk(0, 20.0)
    rest = Trajectory(standing.time, 0.0 * standing.position_W, standing.attitude_WB)
    assert measured_stride(simulate_imu(rest, 100.0, PERFECT_IMU), rest) is None


@pytest.mark.parametrize("way", PLACES)
def test_recorded_people_walk_like_people(way):
    people = stride_cycles(way)
    assert len(people) > 3
    speed = np.array([0.5, 1.0, 1.4, 2.0])
    for person in people:
        rate = step_rate(person, speed)
        assert (np.diff(rate) > 0.0).all()
        assert (np.diff(speed / rate) > 0.0).all()  # steps become longer as well
        assert 1.3 < rate[1] < 2.1
        up = np.abs(person.amplitude[:, 2])
        assert 0.1 < up[1] < 8.0
    # The legs take turns: what is not at one leg rises twice in a stride, and sways once.
    if way in ("handheld", "in-front"):
        rise, sway = (np.mean([np.abs(p.amplitude[:2, k]) for p in people], axis=0) for k in (2, 1))
        assert rise[1] > 5.0 * rise[0]
        assert way == "in-front" or sway[0] > 1.5 * sway[1]


def test_people_of_about_the_speed_are_drawn():
    rng = np.random.default_rng(0)
    slow, fast = (
        np.mean([drawn_cycle(rng, "texting", speed).speed for _ in range(40)])
        for speed in (0.4, 1.3)
    )
    assert slow < 0.65
    assert fast > 1.0


@pytest.mark.parametrize("way", ["handheld", "pocket"])
def test_the_person_measured_in_a_walk_is_the_one_who_walked(way):
    rng = np.random.default_rng(3)
    route = route_along(rng, [Command(60.0, 1.2)], 6000, 100.0, walls=True)
    walk = carried_along(rng, route, 100.0, WalkStyle(carry=way, preferred_speed=1.2))
    recording = simulate_imu(walk, 100.0, PERFECT_IMU)
    found = measured_stride(recording, walk)
    assert found.speed == pytest.approx(1.2, rel=0.02)
    agreement = {person: agreed(person, found) for person in stride_cycles(way)}
    assert max(agreement.values()) > 0.95
    assert np.median(list(agreement.values())) < 0.93
    person = max(agreement, key=agreement.__getitem__)
    sides = [each.quat_xyzw for each in (person, on_other_side(person))]
    assert max(abs(found.quat_xyzw @ quat) for quat in sides) > np.cos(0.5 * 0.1)


def agreed(person: StrideCycle, found: StrideCycle) -> float:
    """How well two strides agree, from 0 to 1, once they are shifted and on one side."""
    a, b = (stride.amplitude[:8].ravel() for stride in on_one_side([person, found]))
    return float(np.abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b))
