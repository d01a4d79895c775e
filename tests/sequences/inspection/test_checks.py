import re
from dataclasses import replace

import numpy as np
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation
from told import UP, refusal, told
from walked import walked

from stario.sequences import InputError, inspect_recording, with_units
from stario.sequences.conventions import SAME_AXES, with_axes, with_conventions
from stario.sequences.inspection.checks import check_units, unit_findings
from stario.sequences.readers import find_recordings, read_recording
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Trajectory
from stario.sequences.simulation.carrying import CARRYING_MODES
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu


def in_degrees(sequence: ImuSequence) -> ImuSequence:
    return replace(sequence, gyro=np.degrees(sequence.gyro))


def without_gravity(sequence: ImuSequence) -> ImuSequence:
    return replace(sequence, accel=sequence.accel - sequence.truth.attitude_WB.apply(UP, True))


@pytest.mark.parametrize("carry", CARRYING_MODES)
def test_walks_pass_and_their_wrong_units_are_named(carry):
    """Swinging arms and pockets rotate the device fast and press it outward, yet units are SI."""
    walk = walked(1, 30.0, imu_seed=1, carry=carry, preferred_speed=1.4)
    check_units(walk)
    check_units(walk.without_truth())
    assert "--gyro-unit deg/s" in refusal(in_degrees(walk).without_truth())
    assert "--accel-unit g" in refusal(replace(walk, accel=walk.accel / STANDARD_GRAVITY))
    assert "--gravity removed" in refusal(without_gravity(walk))
    check_units(with_conventions(without_gravity(walk), gravity="removed"))
    assert "record the raw accelerometer" in refusal(without_gravity(walk).without_truth())


def test_a_hard_shaken_device_and_a_swinging_pocket_pass_but_not_without_gravity():
    """The median norm of its samples exceeds 12.5 m/s^2, yet their average is gravity."""
    shaken = walked(1, 10.0, imu_seed=1, rate=200.0, carry="swinging", preferred_speed=2.0)
    assert np.median(np.linalg.norm(shaken.accel, axis=1)) > 12.5
    check_units(shaken)
    assert "--gravity removed" in refusal(without_gravity(shaken))
    # Its average force is as large in either unit, but not since it turned about the vertical.
    swung = walked(0, 30.0, carry="pocket", preferred_speed=1.4).without_truth()
    assert np.percentile(np.linalg.norm(swung.gyro, axis=1), 95) > 3.0
    assert unit_findings(swung) == []


def test_a_device_at_rest_passes_but_not_with_its_bias_in_degrees():
    """In deg/s, even a bias of 0.01 rad/s rotates gravity away within seconds."""
    t = np.arange(2001) / 100.0
    rest = Trajectory(t, np.zeros((len(t), 3)), Rotation.identity(len(t)))
    still = simulate_imu(rest, 100.0, PHONE_IMU).without_truth()
    biased = replace(still, gyro=still.gyro + np.array([0.01, -0.004, 0.002]))
    check_units(still)
    check_units(biased)
    assert "contradict the accelerometer" in refusal(in_degrees(biased))
    assert "record the raw accelerometer" in refusal(replace(still, accel=still.accel - UP))


def test_a_reversed_sign_and_other_axes_are_named_only_with_a_true_attitude(walk):
    apple = replace(walk, accel=-walk.accel)
    assert "--accel-sign apple" in refusal(apple)
    check_units(with_conventions(apple, accel_sign="apple"))
    check_units(apple.without_truth())
    # Also if gravity points exactly down, which a wrong sign would explain too.
    for axes, undone in (("y,z,x", "z,x,y"), ("x,-y,-z", "x,-y,-z"), ("z,y,-x", "-z,y,x")):
        turned = replace(with_axes(walk, axes), axes=SAME_AXES)
        assert f"--axes={undone}" in refusal(turned)
        check_units(with_axes(turned, undone))
        check_units(turned.without_truth())


def test_a_truth_with_z_down_is_told_from_a_reversed_sign_by_its_positions(walk):
    """Passing the other sign for the accelerometer would break a good recording."""
    turn = Rotation.from_euler("x", np.pi)
    truth = walk.truth
    down = replace(
        truth, position_W=turn.apply(truth.position_W), attitude_WB=turn * truth.attitude_WB
    )
    text = refusal(replace(walk, truth=down))
    assert "a world with z down" in text
    assert "--accel-sign" in text.split("only if that is wrong")[1]
    x, y, z, w = down.quat_xyzw.T
    px, py, pz = down.position_W.T
    assert "write px,-py,-pz,qw,-qz,qy,-qx as px,py,pz,qx,qy,qz,qw" in text
    position, quat_xyzw = np.column_stack([px, -py, -pz]), np.column_stack([w, -z, y, -x])
    right = replace(truth, position_W=position, attitude_WB=Rotation.from_quat(quat_xyzw))
    assert told(replace(walk, truth=right)) == []
    at_rest = replace(down, position_W=0.0 * down.position_W)
    undecided = refusal(replace(walk, truth=at_rest))
    assert "--accel-sign apple" in undecided
    assert "or if the truth's world has z down" in undecided


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_time_in_another_unit_is_named(walk, unit):
    factor = {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    alone = walk.without_truth()
    assert f"`t [{unit}]`" in refusal(replace(alone, time=factor * alone.time))
    divided = refusal(replace(alone, time=alone.time / factor))
    assert f"{factor:.0e} times too short for its unit: convert it" in divided
    assert "`t [s]`" in divided


@pytest.mark.parametrize(("step", "shared"), [(1.0, "194"), (0.1, "19.9")])
def test_rounded_times_are_not_taken_for_a_slow_sensor_or_another_unit(walk, step, shared):
    text = refusal(replace(walk.without_truth(), time=np.round(walk.time / step) * step))
    assert f"found {shared} samples on average at each time" in text
    assert "export them with fractions of a second" in text
    assert "t [ms]" not in text


def batches(walk: ImuSequence) -> ImuSequence:
    """As of a sensor whose samples arrive by radio, four at a time."""
    count = 4 * (len(walk.time) // 4)
    arrived = walk.time[3:count:4].repeat(4) + np.tile(1e-4 * np.arange(4), count // 4)
    return replace(walk.slice(0.0, walk.time[count - 1]), time=arrived)


def alternating(walk: ImuSequence) -> ImuSequence:
    """A recording of which no sample has both sensors."""
    never = ImuSequence("never", walk.time, walk.gyro.copy(), walk.accel.copy())
    never.gyro[::2], never.accel[1::2] = np.nan, np.nan
    return never


def with_a_clock(walk: ImuSequence, sensor: str) -> ImuSequence:
    clock = 1.7e18 + 1e7 * np.arange(len(walk))
    return replace(walk, **{sensor: np.column_stack([clock, np.ones((len(walk), 2))])})


def shuffled(walk: ImuSequence) -> ImuSequence:
    wrong = Rotation.from_quat(walk.truth.quat_xyzw[:, [3, 0, 1, 2]])
    return replace(walk, truth=replace(walk.truth, attitude_WB=wrong))


IN_G = 1.0 / STANDARD_GRAVITY
WRONG = [
    ("--gyro-unit deg/s", lambda w: in_degrees(replace(w, accel=IN_G * w.accel))),
    ("--accel-unit g", lambda w: replace(w, accel=IN_G * w.accel)),
    ("--gyro-unit mdps", lambda w: replace(w, gyro=1e3 * np.degrees(w.gyro))),
    ("neither rad/s nor deg/s", lambda w: replace(w, gyro=1e2 * np.degrees(w.gyro))),
    ("--accel-unit mg", lambda w: replace(w, accel=1e3 * IN_G * w.accel)),
    ("accelerometer", lambda w: replace(w, accel=100.0 * w.accel)),
    ("accelerometer", lambda w: replace(w, accel=0.5 * w.accel)),
    ("accelerometer", lambda w: replace(w, accel=0.0 * w.accel)),
    ("omit the unit g", lambda w: with_units(w.without_truth(), accel_unit="g")),
    ("swapped: exchange them", lambda w: replace(w, gyro=w.accel, accel=w.gyro)),
    ("x y z w", shuffled),
    ("found 10 samples/s, .* 50 to 1000; set the app", lambda w: w.select(np.arange(0, 6000, 20))),
    (r"batches: 200 samples/s, most 0\.0001 s apart, .*space their samples evenly", batches),
    ("duration", lambda w: w.without_truth().slice(0.0, 1.2)),
    ("samples: found 1", lambda w: w.select(np.array([0]))),
    ("time: found no finite sample", lambda w: replace(w.without_truth(), time=np.nan * w.time)),
    ("gyro: found no finite sample", lambda w: replace(w, gyro=np.nan * w.gyro)),
    ("accel: found no finite sample", lambda w: replace(w, accel=np.nan * w.accel)),
    ("usable", alternating),
    (r"gyro: found 1\.7e.18 on average, expected a plaus", lambda w: with_a_clock(w, "gyro")),
    (r"accel: found 1\.7e.18 on average, expected a plaus", lambda w: with_a_clock(w, "accel")),
]


@pytest.mark.parametrize(("words", "change"), WRONG)
def test_what_is_wrong_is_named_with_the_remedy(walk, words, change):
    assert re.search(words, refusal(change(walk)))


def test_a_unit_given_is_used_and_a_short_recording_is_enough(walk):
    gyro, accel = 1e3 * np.degrees(walk.gyro), 1e3 * IN_G * walk.accel
    check_units(with_units(replace(walk, gyro=gyro, accel=accel), "mdps", "mg"))
    check_units(walk.without_truth().slice(0.0, 1.6))


def test_bad_samples_do_not_disturb_the_check(walk):
    rng = np.random.default_rng(0)
    time, gyro, accel = walk.time.copy(), walk.gyro.copy(), walk.accel.copy()
    gyro[rng.integers(0, len(gyro), 200)] = np.nan
    accel[rng.integers(0, len(gyro), 200), 1] = np.inf
    time[500], time[700] = time[499], time[600]
    keep = rng.random(len(time)) > 0.2
    dirty = ImuSequence("dirty", time[keep], gyro[keep], accel[keep])
    check_units(dirty)
    assert "--gyro-unit" in refusal(in_degrees(dirty))


@pytest.mark.parametrize(("period", "lost"), [(4.0, 0.3), (30.0, 20.0)])
@pytest.mark.parametrize("carry", ["swinging", "rig", "pocket"])
def test_gaps_are_not_mistaken_for_wrong_units(carry, period, lost):
    """The device rotates unobserved during gaps; the stretches between determine the units."""
    walk = walked(2, 60.0, imu_seed=2, carry=carry).without_truth()
    kept = walk.time % period > lost
    gappy = ImuSequence("holed", walk.time[kept], walk.gyro[kept], walk.accel[kept])
    check_units(gappy)
    assert "--gyro-unit deg/s" in refusal(in_degrees(gappy))


def test_stretches_too_short_to_determine_the_units_are_ignored():
    walk = walked(2, 60.0, imu_seed=2, carry="pocket")
    kept = walk.time % 0.9 > 0.6
    check_units(ImuSequence("shreds", walk.time[kept], walk.gyro[kept], walk.accel[kept]))


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}")
def test_real_recordings_pass_and_their_wrong_units_are_named():
    paths = [path for name in ("euroc", "oxiod", "tumvi") for path in find_recordings(DATA / name)]
    for path in paths[::6]:
        whole = read_recording(path)
        check_units(whole)
        recording = whole.slice(whole.time[0], whole.time[0] + 60.0)
        assert "--gyro-unit deg/s" in refusal(in_degrees(recording))
        alone = recording.without_truth()
        in_g = replace(alone, accel=alone.accel / STANDARD_GRAVITY)
        assert "--accel-unit g" in refusal(in_g)
        assert "points down" in refusal(replace(recording, accel=-recording.accel))


def test_swapped_gyroscope_axes_are_not_mistaken_for_degrees():
    """A rig turns at 2 rad/s about all axes; the cause is swapped axes, not deg/s."""
    walk = walked(
        11, 30.0, imu_seed=11, carry="rig", preferred_speed=1.4, mount_rotvec=(0.0, 0.0, 0.0)
    ).without_truth()
    text = refusal(replace(walk, gyro=walk.gyro[:, [1, 2, 0]]))
    assert "contradict the accelerometer" in text
    assert "--gyro-unit" not in text
    assert "axes and signs" in text


def test_no_option_is_suggested_that_the_file_rules_out(walk):
    named = replace(walk, converted=frozenset({"gyro", "accel", "sign"}))
    for altered in (
        in_degrees(named),
        replace(named, accel=named.accel / STANDARD_GRAVITY),
        replace(named, accel=-named.accel),
    ):
        text = refusal(altered)
        assert "--" not in text
        assert "the one named in the file" in text


@pytest.mark.parametrize(("axis", "asked"), [(2, True), (0, False)])
def test_the_unit_of_a_vehicle_that_turns_about_the_vertical_is_asked_for(caplog, axis, asked):
    """A quarter of a turn per second for half a minute, as deg/s; another axis moves gravity."""
    time = np.arange(3000) / 100.0
    rate = np.zeros((len(time), 3))
    rate[:, axis] = 5.0 * np.sign(np.sin(0.4 * time))
    angle = np.cumsum(rate[:, axis]) / 100.0
    level = np.zeros((len(time), 3))
    level[:, 2] = 9.81
    tilted = 9.81 * np.column_stack([np.zeros(len(time)), np.sin(angle), np.cos(angle)])
    robot = ImuSequence("robot", time, rate, level if axis == 2 else tilted)
    check_units(replace(robot, source="generic CSV"))
    assert ("--gyro-unit deg/s" in caplog.text) == asked
    caplog.clear()
    check_units(robot)
    assert ("np.radians(gyro)" in caplog.text) == asked
    codes = [found.code for found in inspect_recording(robot).findings]
    assert ("gyro_unit_open" in codes) == asked


def test_a_force_along_minus_z_is_named_for_arrays(walk, caplog):
    """No other sensor tells the sign; a reader has asked for it."""
    down = replace(walk.without_truth(), accel=-walk.accel)
    check_units(walk)
    check_units(replace(down, source="generic CSV"))
    assert not caplog.text
    check_units(down)
    assert "give -accel" in caplog.text


RAW = np.array([0.09, -0.02, 0.01])
"""Bias of an iPhone 5 [rad/s]."""


def raw_walk(carry: str) -> ImuSequence:
    return walked(3, 30.0, imu_seed=3, carry=carry, mount_rotvec=(0.4, -0.7, 1.1)).without_truth()


@pytest.mark.parametrize("carry", ["handheld", "pocket"])
@pytest.mark.parametrize(
    ("axes", "named"), [("yzx", "z, x, y"), ("xyZ", "x, y, -z"), ("Xyz", "-x, y, z")]
)
def test_other_axes_and_signs_are_refused_and_the_right_ones_named(carry, axes, named):
    carried = raw_walk(carry)
    columns = ["xyz".index(name.lower()) for name in axes]
    signs = [-1.0 if name.isupper() else 1.0 for name in axes]
    turned = replace(carried, gyro=carried.gyro[:, columns] * signs)
    with pytest.raises(InputError, match=f"gyroscope: .* its {named}$"):
        check_units(turned)
    check_units(turned.slice(0.0, 5.0))  # so little of a good walk may seem to be wrong as well
    (told,) = [found for found in inspect_recording(turned).findings if found.code == "refused"]
    assert f"its {named}" in told.advice


@pytest.mark.parametrize("carry", ["handheld", "pocket", "swinging", "trolley"])
def test_a_raw_bias_is_no_wrong_axis(carry):
    carried = raw_walk(carry)
    check_units(carried)
    check_units(replace(carried, gyro=carried.gyro + RAW))


def test_a_raw_bias_on_a_table_and_a_ride_are_no_wrong_axis():
    """About the vertical it would turn gravity least."""
    rng, time = np.random.default_rng(0), 0.01 * np.arange(2000)
    noise = 2e-3 * rng.standard_normal((2, 2000, 3))
    check_units(ImuSequence("table", time, RAW + noise[0], np.array([0.0, 0.0, 9.81]) + noise[1]))
    # The car accelerates and brakes and turns: no axes of the gyroscope explain the force.
    time = 0.01 * np.arange(6000)
    noise = 0.01 * np.random.default_rng(0).standard_normal((2, 6000, 3))
    along, turn = 1.5 * np.sin(0.9 * time), 0.3 * np.sin(0.5 * time + 1.0)
    accel = np.column_stack([along, 8.0 * turn, np.full(6000, 9.81)])
    gyro = np.outer(turn, [0.0, 0.0, 1.0])
    check_units(ImuSequence("ride", time, gyro + noise[0], accel + 5.0 * noise[1]))
