import logging

import numpy as np
import pytest
from csv_lines import ROW, write_lines

from stario.sequences import ImuSequence, InputError, ReadError, with_units, write_csv
from stario.sequences.readers.columns import HEADER, TRUTH_HEADER
from stario.sequences.readers.generic_csv import read_generic_csv


def test_bad_samples_and_their_order_are_kept(tmp_path, walk):
    time, gyro, accel = walk.time.copy(), walk.gyro.copy(), walk.accel.copy()
    time[5], time[7] = time[4], time[3]
    gyro[9], accel[11, 1] = np.nan, np.inf
    gyro[12], accel[12] = np.nan, np.nan
    bad = ImuSequence("bad", time, gyro, accel, walk.truth)
    write_csv(tmp_path / "bad.csv", bad)
    read = read_generic_csv(tmp_path / "bad.csv")
    assert np.array_equal(read.time, time)
    assert np.array_equal(read.gyro, gyro, equal_nan=True)
    assert np.array_equal(read.accel, accel, equal_nan=True)
    assert np.array_equal(read.truth.position_W, walk.truth.position_W)


@pytest.mark.parametrize(
    ("unit", "per_second"), [("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9), ("µs", 10**6)]
)
def test_time_is_read_exactly_from_any_epoch(tmp_path, unit, per_second):
    start_ns = 1520531124153717567
    steps = np.cumsum([0, 5000001, 4999998, 5000013])
    digits = len(str(per_second)) - 1
    rows = []
    for step in steps.tolist():
        whole = str(start_ns + step)
        cut = len(whole) - 9 + digits
        rows.append(f"{whole[:cut]}.{whole[cut:]}".rstrip(".") + f",{ROW}")
    header = f"timestamp [{unit}],gx,gy,gz,ax,ay,az"
    read = read_generic_csv(write_lines(tmp_path / "epoch.csv", header, *rows))
    assert read.time.tolist() == [step / 1e9 for step in steps.tolist()]


def test_slower_truth_has_only_its_own_rows_and_an_outlying_time_loses_no_other(tmp_path):
    rows = [
        f"{0.01 * k},{ROW}," + (f"{k},0,1,0,0,0,1" if k % 5 == 0 else ",,,,,,") for k in range(21)
    ]
    rows[20] = rows[20].replace("20,0,1", "20,,nan")
    path = write_lines(tmp_path / "slow.csv", f"{HEADER},{TRUTH_HEADER}", *rows)
    read = read_generic_csv(path)
    assert len(read) == 21
    assert np.allclose(read.truth.time, [0.0, 0.05, 0.1, 0.15])
    assert np.allclose(read.truth.position_W[:, 0], [0, 5, 10, 15])
    none = [row.rsplit(",", 7)[0] + ",,,,,,," for row in rows]
    assert read_generic_csv(write_lines(path, f"{HEADER},{TRUTH_HEADER}", *none)).truth is None
    rows = [f"{0.01 * k + 1e6 * (k == 3)},{ROW},{k},0,1,0,0,0,1" for k in range(10)]
    truth = read_generic_csv(
        write_lines(tmp_path / "wild.csv", f"{HEADER},{TRUTH_HEADER}", *rows)
    ).truth
    assert truth.position_W[:, 0].tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9]


GOOD = [HEADER, f"0,{ROW}", f"0.01,{ROW}", f"0.02,{ROW}"]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (GOOD[1:], "line 1: found '0,0.1,0.2"),
        ([HEADER.replace("gz", "yaw"), *GOOD[1:]], "header: found no gz, expected t [s],gx"),
        ([HEADER.replace("gx [rad/s]", "gx [rpm]"), *GOOD[1:]], "gx: found unit 'rpm', expected"),
        ([HEADER.replace("t [s]", "t [min]"), *GOOD[1:]], "time: found unit 'min', expected s, ms"),
        ([HEADER.replace("ax [m/s^2]", "ax [deg/s]"), *GOOD[1:]], "ax: found unit 'deg/s'"),
        ([HEADER + ",wx", *GOOD[1:]], "line 1, gx: found both wx and gx"),
        ([HEADER + ",px,py,pz,qx", *GOOD[1:]], "found no qy, qz, qw"),
        ([HEADER + ",mx [uT]", *GOOD[1:]], "no my, mz"),
        ([HEADER + ",px [mm],py,pz,qx,qy,qz,qw", *GOOD[1:]], "px: found unit 'mm', expected m"),
        ([HEADER.replace(",", ";"), *GOOD[1:]], "line 2: found 1 values, expected 7; separate"),
        ([HEADER.replace(",", ";"), "0.1;0;0;0;1;2;9", "1;0,1;0;0;1;2;9"], "line 3, gx: ... point"),
        ([*GOOD[:3], "0.02,0.1,0.2"], "line 4: found 3 values, expected 7; is the file cut short?"),
        ([*GOOD[:3], "0.02,0.1,0.2,x,1,2,9"], "line 4, gz: found 'x', expected a number"),
        ([*GOOD[:3], "noon,0.1,0.2,0.3,1,2,9"], "line 4, t: found 'noon', expected a number"),
        ([*GOOD[:3], f",{ROW}"], "line 4, t: found '', expected a time"),
        (GOOD[:1], "rows: found none below the header"),
        (["# nothing else"], "header: found only comments"),
        ([""], "file: found no line"),
        ([f"{HEADER},{TRUTH_HEADER}", *[f"{k},{ROW},1,2,3,0,0,0,{1 - k}" for k in (0, 1)]],
         "line 3, qx qy qz qw: ... unit"),
    ],
)  # fmt: skip
def test_an_error_is_reported_in_one_line(tmp_path, lines, message):
    path = write_lines(tmp_path / "own.csv", *lines)
    with pytest.raises(ReadError) as caught:
        read_generic_csv(path)
    assert "own.csv" in str(caught.value)
    assert all(part in str(caught.value) for part in message.split(" ... "))
    assert "\n" not in str(caught.value)


def test_rows_with_too_many_values_are_told_and_those_with_blank_ends_stay_separate(
    tmp_path, caplog
):
    rows = [f"{0.01 * k:.2f},{ROW}" + (",7" if k in {3, 5} else ",") for k in range(8)]
    read = read_generic_csv(write_lines(tmp_path / "own.csv", HEADER, *rows))
    assert len(read) == 8
    assert "line 5 and 1 others" in caplog.text
    assert np.allclose(read.accel, [1.0, 2.0, 9.0])
    header = f"{TRUTH_HEADER},{HEADER},note"
    truths = ["1,2,3,0,0,0,1", ",,,,,,", " , , ,,,,", "4,5,6,0,0,0,1"]
    rows = [f"{truth},{0.01 * k:.2f},{ROW}," for k, truth in enumerate(truths)]
    read = read_generic_csv(write_lines(tmp_path / "both.csv", header, *rows))
    assert np.allclose(read.time, [0.0, 0.01, 0.02, 0.03])
    assert np.allclose(read.accel, [1.0, 2.0, 9.0])
    assert read.truth.time.tolist() == [0.0, 0.03]


@pytest.mark.parametrize("names", ["x,y,z,qx,qy,qz,qw", "qx,qy,qz,qw", "pos_x_m,pos_y_m,pos_z_m"])
def test_unread_columns_that_look_like_truth_give_a_warning(tmp_path, caplog, names):
    cells = f"0,{ROW}" + ",1" * (names.count(",") + 2)
    path = write_lines(tmp_path / "own.csv", f"{HEADER},note,{names}", cells)
    with caplog.at_level(logging.INFO):
        assert read_generic_csv(path).truth is None
    assert "columns ignored: note" in caplog.text
    (record,) = (r for r in caplog.records if r.levelno == logging.WARNING)
    assert f"no ground truth is read from {names.replace(',', ', ')}: " in record.getMessage()


def test_a_unit_named_in_the_header_is_not_converted_again(tmp_path):
    header = "t,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]"
    named, down, plain = (
        read_generic_csv(write_lines(tmp_path / f"{name}.csv", titles, *GOOD[1:]))
        for name, titles in (
            ("named", header),
            ("down", header.replace("[g]", "[-g]")),
            ("plain", HEADER),
        )
    )
    for read, options, words in (
        (named, {"gyro_unit": "deg/s"}, "named, whose file names its unit.*omit"),
        (named, {"accel_unit": "-g"}, "named, whose file names its unit.*omit"),
        (down, {"accel_unit": "-m/s^2"}, "down, whose sign was already turned.*omit"),
    ):
        with pytest.raises(InputError, match=words):
            with_units(read, **options)
    assert np.array_equal(with_units(named).gyro, named.gyro)
    assert np.allclose(with_units(plain, gyro_unit="deg/s").gyro, np.radians(plain.gyro))
