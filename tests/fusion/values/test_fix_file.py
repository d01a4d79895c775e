"""Files of fixes: columns, units, and errors that name the line."""

import numpy as np
import pytest

from stario.fusion.values.fix_file import check_within, read_fixes
from stario.fusion.values.fixes import position_fix
from stario.fusion.values.floors import FloorChange, floor_at, floor_changes
from stario.sequences.errors import InputError, ReadError
from stario.sequences.sequence import ImuSequence

HEADER = "t,kind,x,y,z,sx,sy,sz\n"


def test_a_file_of_fixes_is_read(tmp_path):
    path = tmp_path / "fixes.csv"
    path.write_text(
        HEADER + "1.5,position,1,2,3,0.1,,0.3\n\n2,yaw,0.7,,,0.05,,\n3, velocity,1,0,0,0.2\n",
        encoding="utf-8",
    )
    position, yaw, velocity = read_fixes(path)
    assert (position.kind, yaw.kind, velocity.kind) == ("position", "yaw", "velocity")
    assert (position.time, yaw.time) == (1.5, 2.0)
    np.testing.assert_allclose(position.value, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(position.covariance, np.diag([0.01, 0.01, 0.09]))
    np.testing.assert_allclose(yaw.covariance, [[0.0025]])


def test_a_folder_or_a_missing_file_is_no_file_of_fixes(tmp_path):
    with pytest.raises(ReadError, match="file: found is a directory, expected a readable file"):
        read_fixes(tmp_path)
    with pytest.raises(ReadError, match="fixes"):
        read_fixes(tmp_path / "fixes.csv")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_a_spreadsheets_blank_cells_and_encoding_are_read(tmp_path, encoding):
    path = tmp_path / "fixes.csv"
    table = "t,kind,x,y,sx,,\n1.5,position,1,2,0.1,,\n2,yaw,0.7,,0.05,,\n,,,,,\xa0,\n"
    path.write_bytes(table.replace(",", "\t").encode(encoding))
    assert [fix.kind for fix in read_fixes(path)] == ["position", "yaw"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no lines"),
        (HEADER + "1,yaw [deg],17,,,500,,\n", r"yaw: found 17 \+- 500, expected radians$"),
        ("time,kind\n", "line 1.*header"),
        (HEADER + "1,altitude,1,2,3,1,,\n", "line 2, kind.*altitude"),
        (HEADER + "1,position,1,2,3,1,,\nx,position,1,2,3,1,,\n", "line 3, t"),
        (HEADER + "1,position,1,2,,1,,0.5\n", "line 2, z"),
        (HEADER + "1,yaw,170,,,5,,\n", r"yaw.*radians.*\[deg\]"),
        (HEADER + "1,position [deg],1,2,3,1,,\n", "line 2, kind"),
        ("t,kind,x [cm],y [cm],sx\n", r"line 1.*\[cm\]"),
        ("t [ms],kind,x [m],y,sx\n", r"line 1.*\[ms\]"),
        (HEADER + "1,position,1,2,3,,,\n", "line 2, sx"),
        (HEADER + "1,position,1,2,3,0,,\n", "sigma.*> 0"),
        (HEADER + "1,position,1,2,nan,1,,\n", "line 2, z.*nan"),
        (HEADER + "1,position,1,2,3,1,1,1,1\n", "9 values"),
        (HEADER.strip() + ",note\n1,position,1,2,3,1,1,1,a\n", "line 1.*unknown column 'note'"),
        ("t,kind,x,y\n1,position,1,2\n", "line 1.*no column 'sx'"),
        ("t,kind,x,y,y,sx\n1,position,1,2,2,1\n", "line 1.*two columns 'y'"),
        ("# mine\n\n" + HEADER + "# a, b\n1,position,1,2,3,0,,\n", "line 5, sigma"),
        ("# mine\n", "line 1: found nothing"),
        (HEADER + "\n", "a header only, expected at least one fix"),
    ],
)
def test_an_invalid_file_raises_an_error_that_names_line_and_field(tmp_path, text, match):
    path = tmp_path / "fixes.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ReadError, match=match) as caught:
        read_fixes(path)
    assert "fixes.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_columns_may_be_in_any_order_in_degrees_and_without_height(tmp_path):
    path = tmp_path / "fixes.csv"
    rows = [
        "# from the plan",
        "Kind;t [s];x;y;z;sx",
        "position;1;2;3;;0.5",
        "# 2",
        "yaw[deg];2;170;;;5",
    ]
    path.write_text("\n".join(rows))
    position, yaw = read_fixes(path)
    np.testing.assert_allclose(position.value, [2.0, 3.0, 0.0])
    assert position.covariance[0, 0] == pytest.approx(0.25)
    assert position.covariance[2, 2] == pytest.approx(1e6)
    np.testing.assert_allclose(yaw.value, [np.radians(170.0)])
    np.testing.assert_allclose(yaw.covariance, [[np.radians(5.0) ** 2]])


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read(tmp_path, separator):
    lines = ["t;kind;x;y;sx", "5,0;position;0,5;-1;1,5", "20;position;3;4,25;1e0"]
    path = tmp_path / "fixes.csv"
    path.write_text("\n".join(lines).replace(";", separator))
    first, second = read_fixes(path)
    assert (first.time, second.time) == (5.0, 20.0)
    np.testing.assert_allclose(first.value, [0.5, -1.0, 0.0])
    np.testing.assert_allclose(second.value, [3.0, 4.25, 0.0])
    assert first.covariance[0, 0] == pytest.approx(2.25)


@pytest.mark.parametrize("by", [-100.0, 100.0])
def test_fixes_before_or_after_the_recording_are_on_another_clock(by):
    time, zero = np.arange(101) / 10.0, np.zeros((101, 3))
    sequence = ImuSequence("walk", time, zero, zero)
    fixes = [position_fix(at + by, np.zeros(3), np.eye(3)) for at in (2.0, 4.0)]
    with pytest.raises(InputError, match=r"fixes: found times from .* expected some within"):
        check_within(fixes, sequence)
    check_within([*fixes, position_fix(5.0, np.zeros(3), np.eye(3))], sequence)


# --- floors ---------------------------------------------------------------------------------------


DRIFT = 0.3
"""Drift of the height over each track [m]."""


def found(*legs: tuple[float, float, float]) -> tuple[list[FloorChange], float]:
    """Return the changes of a track of legs of seconds, climb [m] and horizontal speed [m/s]."""
    ends = np.cumsum([(0.0, 0.0), *((seconds, climb) for seconds, climb, _ in legs)], axis=0)
    time = np.arange(0.0, ends[-1, 0], 0.1)
    height = np.interp(time, ends[:, 0], ends[:, 1]) + DRIFT * time / time[-1]
    speeds = np.array([speed for *_, speed in legs])
    return floor_changes(time, height, speeds[np.searchsorted(ends[1:-1, 0], time)])


@pytest.mark.parametrize("spacing", [2.7, 3.2, 4.0])
def test_stairs_and_a_lift_between_floors_of_any_distance(spacing):
    changes, distance = found(
        (30, 0, 1.2), (12, spacing, 0.5), (20, 0, 1.2), (15, -3 * spacing, 0.0), (20, 0, 1.0)
    )
    assert [(c.before, c.after, c.how) for c in changes] == [(0, 1, "stairs"), (1, -2, "lift")]
    assert distance == pytest.approx(spacing, abs=0.2)
    assert changes[0].start == pytest.approx(30.0, abs=2.5)
    assert changes[0].stop == pytest.approx(42.0, abs=2.5)
    assert [floor_at(changes, t) for t in (0.0, 36.0, 50.0, 95.0)] == [0, None, 1, -2]
    assert str(changes[1]).startswith("floor 1 to -2 by lift, 6")


def test_landings_are_no_floors():
    for rest in (3.0, 11.0):  # at once, and after a look out of the window
        changes, _ = found((30, 0, 1.2), (6, 1.5, 0.5), (rest, 0, 0.2), (6, 1.5, 0.5), (30, 0, 1.2))
        assert [(c.before, c.after) for c in changes] == [(0, 1)]


def test_a_level_walk_a_ramp_and_a_doorstep_are_one_floor():
    for legs in ([(300, 0.0, 1.2)], [(60, 2.0, 1.2)], [(30, 0, 1.2), (3, 0.6, 1.0), (30, 0, 1.2)]):
        assert found(*legs) == ([], 0.0)


def test_too_short_a_track_has_no_floors():
    assert found((2.0, 0.0, 1.0)) == ([], 0.0)
