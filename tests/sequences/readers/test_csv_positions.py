"""Positions without attitude in a generic CSV: waypoints, tracks and their accuracy."""

from dataclasses import replace

import numpy as np
import pytest
from csv_lines import ROW, write_lines

from stario.sequences.errors import ReadError
from stario.sequences.readers import read_recording, write_csv
from stario.sequences.readers.generic_csv import read_generic_csv
from stario.sequences.sequence import (
    PositionTrack,
)


@pytest.mark.parametrize(
    ("every", "columns", "kind"), [(4.0, 2, "waypoints"), (0.5, 3, "positions")]
)
def test_positions_without_attitude_are_kept_as_such(tmp_path, walk, every, columns, kind):
    time = np.arange(walk.time[0] + 0.3, walk.time[-1], every)
    position = walk.truth.at(time).position_W[:, :columns]
    known = PositionTrack(time, position, kind)
    write_csv(tmp_path / "walk.csv", replace(walk, truth=None, positions=known))
    found = read_recording(tmp_path / "walk.csv")
    assert found.truth is None
    assert found.positions.kind == kind
    np.testing.assert_allclose(found.positions.time, time - walk.time[0], atol=1e-9)
    np.testing.assert_array_equal(found.positions.position_W, position)
    np.testing.assert_array_equal(found.accel, walk.accel)


def test_the_accuracy_of_positions_is_kept(tmp_path, walk):
    time = np.arange(1.0, 6.0)
    place, sigma = np.stack([time, -time], axis=1), 0.5 * time
    known = PositionTrack(time, place, "positions", sigma=sigma)
    write_csv(tmp_path / "walk.csv", replace(walk, truth=None, positions=known))
    found = read_recording(tmp_path / "walk.csv").positions
    assert found.sigma is not None
    np.testing.assert_array_equal(found.position_W, place)
    np.testing.assert_array_equal(found.sigma, sigma)


@pytest.mark.parametrize(
    ("cells", "times", "error"),
    [
        (("3.0", "2.0", "4.0"), [0.2, 0.5, 0.8], ""),
        (("3.0", "", "4.0"), [0.2, 0.8], ""),
        (("3.0", "0.0", "4.0"), [], "line 52, sp: found 0, expected a standard deviation above 0"),
    ],
)
def test_a_position_without_its_accuracy_is_none(tmp_path, cells, times, error):
    rows = [f"{0.01 * k:.2f},{ROW},,," for k in range(100)]
    for k, cell in zip((20, 50, 80), cells, strict=True):
        rows[k] = f"{0.01 * k:.2f},{ROW},{k},0,{cell}"
    path = write_lines(tmp_path / "a.csv", "t [s],gx,gy,gz,ax,ay,az,px,py,sp [m]", *rows)
    if error:
        with pytest.raises(ReadError, match=error):
            read_generic_csv(path)
    else:
        known = read_generic_csv(path).positions
        np.testing.assert_allclose(known.time, times)


def test_an_accuracy_next_to_poses_is_ignored(tmp_path, walk):
    write_csv(tmp_path / "walk.csv", walk)
    header, *rows = (tmp_path / "walk.csv").read_text().splitlines()
    write_lines(tmp_path / "sp.csv", f"{header},sp", *(f"{row},3.0" for row in rows))
    found = read_recording(tmp_path / "sp.csv")
    assert found.truth is not None
    assert found.positions is None


def test_waypoints_listed_below_the_samples_may_be_in_any_order(tmp_path):
    samples = [f"{0.01 * k:.2f},{ROW},," for k in range(1000)]
    waypoints = [f"{time},,,,,,,{time + 1},0" for time in (8, 2, 5)]
    header = "t,gx,gy,gz,ax,ay,az,px,py"
    known = read_generic_csv(
        write_lines(tmp_path / "a.csv", header, *samples, *waypoints)
    ).positions
    assert known.time.tolist() == [2.0, 5.0, 8.0]
    assert known.position_W[:, 0].tolist() == [3.0, 6.0, 9.0]
