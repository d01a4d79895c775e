import numpy as np
import pytest

from stario.fusion.imu.barometer import UNKNOWN_RATE, HeightBuffer, HeightSample
from stario.sequences.units import pressure_altitude, standard_pressure

RATE = 8.0


def judged(heights: np.ndarray, noise: float = 0.05, seed: int = 0) -> list[HeightSample | None]:
    """Return the averages of pressures at these heights, `RATE` per second."""
    rng, buffer = np.random.default_rng(seed), HeightBuffer()
    pressures = standard_pressure(300.0 + heights + noise * rng.standard_normal(len(heights)))
    found = []
    for k, pressure in enumerate(pressures):
        assert buffer.add(k / RATE, float(pressure), k / RATE)
        if k % 4 == 3:
            found.append(buffer.at(k / RATE))
    # Less than four heights say nothing about climbs.
    assert [each.rate for each in found[:3]] == [UNKNOWN_RATE] * 3
    return [*(each._replace(rate=0.0) for each in found[:3]), *found[3:]]


def ramp(rate: float, begin: float = 10.0, end: float = 22.0, until: float = 32.0) -> np.ndarray:
    time = np.arange(0.0, until, 1.0 / RATE)
    return rate * np.clip(time - begin, 0.0, end - begin)


def test_a_hectopascal_is_eight_and_a_half_metres_near_the_sea():
    altitude = pressure_altitude(np.array([1000.0, 1001.0]))
    assert 8.3 < altitude[0] - altitude[1] < 8.5
    np.testing.assert_allclose(pressure_altitude(standard_pressure(altitude)), altitude, atol=1e-3)


def test_heights_count_from_the_first_and_their_sigma_is_that_of_the_data():
    for noise in (0.03, 0.3):
        found = [each for each in judged(np.zeros(400), noise) if each is not None]
        assert abs(found[0].height) < 2.0 * noise
        # Four samples make an average, whose noise is taken for correlated: twice the sigma.
        assert found[-1].sigma == pytest.approx(noise, rel=0.35)


@pytest.mark.parametrize("rate", [0.25, -0.3, 1.5])
def test_stairs_and_lifts_are_climbs_while_they_last(rate):
    found = judged(ramp(rate))
    climbing = {each.time: each.rate for each in found if each is not None and each.rate}
    times = np.array(list(climbing))
    assert times[0] < 13.0
    assert 20.0 < times[-1] < 26.0
    assert np.sign(list(climbing.values())) == pytest.approx(np.sign(rate))
    # What was not known to be a climb before it was one is said once.
    risen = [each.risen for each in found if each is not None and each.risen]
    assert len(risen) == 1
    assert risen[0] * rate > 0.0


def test_a_level_floor_is_no_climb():
    for seed in range(5):
        found = judged(np.zeros(800), noise=0.2, seed=seed)
        assert all(each is not None and each.rate == each.stepped == 0.0 for each in found)


@pytest.mark.parametrize("step", [0.6, -0.9, 2.5, -3.8])
@pytest.mark.parametrize("begin", [99, 101])
def test_a_door_is_held_back_and_then_a_step_of_the_air(step, begin):
    heights = np.where(np.arange(240) < begin, 0.0, step)
    found = judged(heights)
    assert [each for each in found if each is not None and each.rate] == []
    assert any(each is None for each in found)
    steps = [each.stepped for each in found if each is not None and each.stepped]
    assert steps == pytest.approx([step], abs=0.15)


@pytest.mark.parametrize("door", [-2.5, 1.6])
def test_a_door_as_a_climb_begins_is_told_from_it(door):
    """A door changes the height at once, whoever begins to climb the speed."""
    heights = ramp(0.8) + door * (np.arange(256) >= 88)
    known = [each for each in judged(heights) if each is not None]
    assert sum(each.stepped for each in known) == pytest.approx(door, abs=0.3)
    assert 0.5 < sum(each.risen for each in known) < 5.0
    assert known[-1].height == pytest.approx(9.6 + door, abs=0.2)


def test_a_puff_of_air_is_held_back_and_nothing_else():
    heights = np.zeros(240)
    heights[100:108] = 0.8
    found = judged(heights)
    known = [each for each in found if each is not None]
    assert len(known) < len(found)
    assert all(each.rate == each.stepped == 0.0 for each in known)


def test_one_pressure_a_second_is_enough_and_none_is_none():
    buffer, found, rng = HeightBuffer(), [], np.random.default_rng(0)
    for k in range(30):
        height = 0.3 * max(0, k - 15) + 0.01 * rng.standard_normal()
        buffer.add(float(k), float(standard_pressure(np.array(height))), float(k))
        found += [buffer.at(k + 0.1), buffer.at(k + 0.6)]
    assert found[::2].count(None) < 4
    assert all(each is None for each in found[1::2])
    assert [each.rate for each in found if each is not None][-1] == pytest.approx(0.3, abs=0.02)


def test_what_rises_faster_than_any_lift_is_no_height():
    heights = np.zeros(400)
    heights[160:] = 60.0  # the pressure of another place: from then on it is the height
    heights[80:84] = -40.0
    found = judged(heights)
    assert found[20] is None
    used = [abs(each.height) for each in found[:40] if each is not None]
    assert len(used) > 30
    assert max(used) < 1.0
    assert found[-1].height == pytest.approx(60.0, abs=1.0)


def logged(pressures: np.ndarray) -> tuple[HeightBuffer, list[HeightSample]]:
    """Return the buffer that these pressures [hPa] have passed, `RATE` per second, and heights."""
    buffer, found = HeightBuffer(), []
    for k, pressure in enumerate(pressures):
        buffer.add(k / RATE, float(pressure), k / RATE)
        if k % 4 == 3:
            found.append(buffer.at(k / RATE))
    return buffer, [each for each in found if each is not None]


@pytest.mark.parametrize(("decimals", "longest"), [(4, 3.0), (2, 10.0)])
def test_a_sensor_that_has_stopped_tells_nothing(decimals, longest):
    noise = 0.05 * np.random.default_rng(0).standard_normal(400)
    pressures = standard_pressure(300.0 + noise).round(decimals)
    stuck = np.where(np.arange(400) < 160, pressures, pressures[160])
    buffer, found = logged(stuck)
    assert found[-1].time == pytest.approx(20.0, abs=0.7)  # noise never repeats
    assert buffer.silence == pytest.approx((20.0 + longest, 30.0 - longest), abs=0.7)
    # A slow sensor may measure the same twice.
    slow = HeightBuffer()
    assert all(slow.add(5.0 * k, 1000.0004 + 0.001 * (k // 2), 5.0 * k) for k in range(20))


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("decimals", [0, 1])
def test_a_coarse_sensor_knows_heights_to_its_resolution(decimals, precision):
    """A tenth of a hectopascal is 0.87 m; that it repeats does not mean that it has stopped."""
    pressures = standard_pressure(300.3 + ramp(0.25)).round(decimals).astype(precision)
    buffer, found = logged(pressures)
    assert len(found) >= len(pressures) // 4 - 1  # eight metres at once are faster than a lift
    assert buffer.silence[1] < 1.0
    first, *_, last = found
    rounding = 8.7 * 10.0**-decimals / np.sqrt(12.0)
    assert first.sigma > rounding
    assert all(each.stepped == 0.0 for each in found)
    # Eight metres do not tell whether one climbs; equal heights are one measurement, not many.
    assert (last.rate == UNKNOWN_RATE) == (decimals == 0)
    level = [each.sigma for each in found[: 2 * 8] if each.height == first.height]
    assert np.sum(np.square(rounding / np.array(level))) < 1.1
