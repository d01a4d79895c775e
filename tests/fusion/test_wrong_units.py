from dataclasses import replace

import numpy as np
import pytest
from support import CONFIG, samples, stream, stream_deviation

from stario.fusion import Navigator
from stario.sequences import STANDARD_GRAVITY, ImuSequence, InputError


def specific_force(walk: ImuSequence) -> np.ndarray:
    return walk.truth.attitude_WB.apply([0.0, 0.0, 9.80665], inverse=True)


@pytest.mark.parametrize(
    ("wrong", "remedy"),
    [
        (lambda walk: replace(walk, gyro=np.degrees(walk.gyro)), r"np\.radians\(gyro\)"),
        (lambda walk: replace(walk, accel=walk.accel / 9.80665), "9.80665 . accel"),
        (lambda walk: replace(walk, accel=walk.accel - specific_force(walk)), "accelerometer"),
    ],
)
def test_wrong_units_and_missing_gravity_are_refused(walk, still_model, wrong, remedy):
    for sequence in (wrong(walk), wrong(walk).without_truth()):
        with pytest.raises(InputError, match=remedy) as caught:
            Navigator(still_model).run(sequence)
        assert "\n" not in str(caught.value)
        assert "--" not in str(caught.value)  # no option of the command


@pytest.mark.parametrize("scale", [1 / 9.80665, 0.0])
def test_a_stream_in_wrong_units_is_refused_after_its_first_second(walk, make_oracle, scale):
    navigator = Navigator(make_oracle(walk, walk.truth, CONFIG))
    with pytest.raises(InputError, match="accel"):
        stream(navigator, replace(walk, accel=scale * walk.accel))
    assert navigator.state is None
    track = Navigator(navigator.model, backend="ekf").run(walk)
    assert stream_deviation(stream(navigator, walk.slice(0.0, 5.0)), track) < 1e-9


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        # In deg/s the force averages to nothing, although each sample of it is right.
        (lambda gyro, accel: (np.degrees(gyro) + 40.0, accel), r"^gyro.*np\.radians\(gyro\)"),
        (lambda gyro, accel: (accel, gyro), "swapped"),
        (lambda gyro, accel: (gyro[:, [1, 0, 2]], accel), "^gyro.* y, x, z$"),
    ],
)
def test_a_stream_blames_the_right_sensor(make_walk, still_model, wrong, words):
    walk = make_walk(1, 26.0, carry="pocket")
    gyro, accel = wrong(walk.gyro, walk.accel)
    with pytest.raises(InputError, match=words):
        stream(Navigator(still_model), replace(walk, gyro=gyro, accel=accel))


def test_an_inverted_accelerometer_and_a_field_in_gauss_are_said(still_model, caplog):
    navigator = Navigator(still_model)
    noise = 0.02 * np.random.default_rng(0).standard_normal((300, 6))
    for k, row in enumerate(noise):
        navigator.push_magnetometer(0.01 * k, [0.2, row[0], -0.43])
        navigator.push(0.01 * k, row[:3], row[3:] - [0.0, 0.0, STANDARD_GRAVITY])
    assert "give -accel" in caplog.text
    assert caplog.text.count("gauss") == 1


def after_a_still_start(walk: ImuSequence) -> ImuSequence:
    """The walk, preceded by ten seconds at rest in its first attitude."""
    step = walk.time[1] - walk.time[0]
    rest = round(10.0 / step)
    noise = 0.01 * np.random.default_rng(0).standard_normal((rest, 6))
    up_B = specific_force(walk)[0]
    time = step * np.arange(rest + len(walk))
    gyro = np.vstack([noise[:, :3], walk.gyro])
    accel = np.vstack([up_B + noise[:, 3:], walk.accel])
    return replace(walk, time=time, gyro=gyro, accel=accel, truth=None)


def test_a_stream_in_degrees_is_refused_once_the_device_turns(make_walk, still_model):
    right = after_a_still_start(make_walk(3, 16.0, carry="swinging"))
    navigator = Navigator(still_model)
    stream(navigator, right.select(slice(300)))
    with pytest.raises(InputError, match=r"gyro.*rad/s.*deg/s"):
        stream(navigator, replace(right, gyro=np.degrees(right.gyro)).slice(3.0, 36.0))
    assert navigator.state is None
    # The stream has restarted; in rad/s it is never refused.
    assert len(stream(navigator, right)) > 200


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_stream_with_a_sensor_dead_from_the_beginning_is_refused(make_walk, still_model, sensor):
    right = after_a_still_start(make_walk(1, 26.0)).slice(0.0, 20.0)
    dead = replace(right, **{sensor: np.tile(getattr(right, sensor)[0], (len(right), 1))})
    navigator = Navigator(still_model)
    with pytest.raises(InputError, match=f"{sensor}.*never change"):
        stream(navigator, dead)
    assert navigator.state is None
    assert stream(navigator, right.slice(0.0, 3.0))


def starts_and_stops(gyro: np.ndarray) -> ImuSequence:
    time = 0.01 * np.arange(4800)
    shaken = np.where(time % 12.0 < 6.0, np.sin(6.0 * time), 0.0)
    accel = np.array([0.0, 0.0, STANDARD_GRAVITY]) + np.outer(shaken, [0.5, 1.0, 2.0])
    return ImuSequence("starts and stops", time, np.tile(gyro, (1200, 1)), accel)


def test_calm_in_between_does_not_hide_a_gyroscope_that_is_dead_from_the_beginning(still_model):
    with pytest.raises(InputError, match=r"gyro.*never change"):
        stream(Navigator(still_model), starts_and_stops(np.zeros((4, 3))))
    live = np.outer([0.0, 0.001, 0.0, 0.002], [1.0, 1.0, 1.0])
    assert stream(Navigator(still_model), starts_and_stops(live))[-1].time > 47.0


def test_a_briefly_tumbling_device_is_not_mistaken_for_a_stream_in_degrees(make_walk, still_model):
    walk = make_walk(3, 26.0)
    gyro = walk.gyro.copy()
    for k in (550, 1350, 2150):  # each within a piece or across its end, between calm ones
        gyro[k : k + 100] += [0.0, 30.0, 30.0]  # faster than anyone turns it
    assert stream(Navigator(still_model), replace(walk, gyro=gyro))


def test_a_turn_within_gaps_is_not_taken_for_wrong_units(still_model):
    """The device turns while it is measured and rests in every gap: nobody knows what it did."""
    time = 0.01 * np.arange(2400)
    measured = time % 4.0 < 2.5
    turned = np.cumsum(np.where(measured, 0.02, 0.0))  # 2 rad/s about x
    accel = STANDARD_GRAVITY * np.column_stack([0.0 * time, np.sin(turned), np.cos(turned)])
    gyro = np.tile([2.0, 0.0, 0.0], (len(time), 1))
    samples = ImuSequence("turns", time[measured], gyro[measured], accel[measured])
    assert stream(Navigator(still_model), samples)[-1].time > 22.0


def test_the_check_for_degrees_survives_a_snapshot(walk, still_model):
    wrong = after_a_still_start(walk)
    wrong = replace(wrong, gyro=np.degrees(wrong.gyro))

    def refused_at(stop):
        """Time at which the stream is refused if another navigator continues it at `stop`."""
        navigator = Navigator(still_model)
        for row in samples(wrong):
            if row[0] == stop:
                data, navigator = navigator.snapshot(), Navigator(still_model)
                navigator.restore(data)
            try:
                navigator.push(*row)
            except InputError:
                return float(row[0])
        return np.inf

    whole = refused_at(np.nan)
    assert refused_at(float(wrong.time[1710])) == whole < 26.0
