"""Tables whose times are in several columns, in a file of their own, or nowhere.

Those that are read are among the exports of `phone_exports`.
"""

import numpy as np
import pytest
from alike import assert_same_samples
from phone_exports import export, save

from stario.sequences import StarioError, read_recording

SENSORS = ",".join(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")


def test_a_cut_row_and_a_file_of_too_few_times_are_named(tmp_path, walk):
    export("seconds_and_nanoseconds", tmp_path, walk)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    lines[6] = lines[6].rsplit(",", 4)[0]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(StarioError, match=r"a\.csv: line 7"):
        read_recording(tmp_path / "a.csv")
    folder = tmp_path / "few"
    export("times_in_a_file", folder, walk)
    save(folder / "time.csv", "time", walk.time[: len(walk) // 2])
    with pytest.raises(StarioError, match=f"found {len(walk) // 2} and {len(walk)} rows"):
        read_recording(folder)


def test_a_table_without_times_is_read_at_the_rate_given(tmp_path, walk):
    columns = np.arange(len(walk)), walk.gyro, walk.accel
    path, timed, counted = (tmp_path / f"{name}.csv" for name in ("a", "b", "MT"))
    wide = ",".join(f"{name}_{axis}" for name in ("Gyr", "Acc") for axis in "XYZ")
    save(path, f"count,{SENSORS}", *columns)
    save(timed, f"time [s],{SENSORS}", *columns)
    save(counted, f"// Update Rate: 100.0Hz\nPacketCounter,{wide}", *columns)
    assert_same_samples(read_recording(path, rate="200"), walk)
    for file, options, message in (
        (path, {}, "--rate"),
        (counted, {}, r"MT\.csv: time: .*`t \[s\]`"),
        (path, {"rate": "0"}, "samples per second"),
        (timed, {"rate": "200"}, r"the column time \[s\]"),
    ):
        with pytest.raises(StarioError, match=message):
            read_recording(file, **options)
