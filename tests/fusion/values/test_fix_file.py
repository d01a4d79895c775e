import numpy as np
import pytest

from stario.fusion.values.fix_file import check_within, read_fixes
from stario.fusion.values.fixes import position_fix
from stario.fusion.values.floors import FloorChange, floor_at, floor_changes
from stario.sequences import ImuSequence, InputError, ReadError

HEADER = "t,kind,x,y,z,sx,sy,sz\n"


def test_a_folder_or_a_missing_file_is_no_file_of_fixes(tmp_path):
    for path, named in ((tmp_path, "directory"), (tmp_path / "fixes.csv", "fixes")):
        with pytest.raises(ReadError, match=named):
            read_fixes(path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no lines"),
        (HEADER + "1,yaw [deg],17,,,500,,\n", "yaw.*17.*500.*radians$"),
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
        (HEADER.strip() + ",note\n1,position,1,2,3,1,1,1,a\n", "line 1.*unknown.*'note'"),
        ("t,kind,x,y\n1,position,1,2\n", "line 1.*no column 'sx'"),
        ("t,kind,x,y,y,sx\n1,position,1,2,2,1\n", "line 1.*two.*'y'"),
        ("# mine\n\n" + HEADER + "# a, b\n1,position,1,2,3,0,,\n", "line 5, sigma"),
        ("# mine\n", "line 1: found nothing"),
        (HEADER + "\n", "header only"),
    ],
)
def test_an_invalid_file_raises_an_error_that_names_line_and_field(tmp_path, text, match):
    path = tmp_path / "fixes.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ReadError, match=match) as caught:
        read_fixes(path)
    assert "fixes.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (["48.15010,11.58030,3", "48.15012,11.58041,3", "48.15022,11.58051,3"], True),
        (["48.15,11.58,3", "54.15,12.58,3", "58.15,10.58,3"], False),
        (["48.15,11.58,3", "48.15,11.58,3", "48.15,11.58,3"], False),
        (["48.150,11.580,0.001", "48.152,11.581,0.001", "48.151,11.583,0.001"], False),
    ],
    ids=["degrees", "metres", "one place", "motion capture"],
)
def test_positions_in_degrees_are_told(rows, told, tmp_path, caplog):
    lines = [f"{k},position,{row}" for k, row in enumerate(rows)]
    (tmp_path / "fixes.csv").write_text("\n".join(["t,kind,x,y,sx", *lines]))
    assert len(read_fixes(tmp_path / "fixes.csv")) == len(rows)
    assert ("degrees of latitude" in caplog.text) == told


PLAIN = "t,kind,x,y,z,sx,sy,sz\n5.5,position,1,-2,3,0.1,,0.3\n\n6,yaw,0.5,,,0.05,,\n"
LAYOUTS = {
    "short last row": PLAIN.removesuffix(",,\n"),
    "blank cells": PLAIN.replace("\n", ",\xa0\n").replace("\xa0\n", "\n", 1) + ",,,,,\xa0,,,\n",
    "any order": "Kind;t [s];z;x;y;sz;sx\nposition;5.5;3;1;-2;0.3;0.1\nyaw;6;;0.5;;;0.05\n",
    "degrees": PLAIN.replace("yaw,0.5,,,0.05", f"yaw[deg],{np.degrees(0.5)},,,{np.degrees(0.05)}"),
    "decimal commas": PLAIN.replace(",", ";").replace(".", ",").replace(";6;", ";6,0;"),
    "comments": "# my fixes; two\n" + PLAIN.replace("6,", " # second\n6,"),
    "commas and tabs": PLAIN.replace(",", "\t").replace(".", ","),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_a_table_gives_the_same_fixes(tmp_path, layout, encoding):
    path = tmp_path / "fixes.csv"
    path.write_text(LAYOUTS[layout], encoding=encoding)
    position, yaw = read_fixes(path)
    assert [(fix.kind, fix.time) for fix in (position, yaw)] == [("position", 5.5), ("yaw", 6.0)]
    np.testing.assert_allclose(position.value, [1.0, -2.0, 3.0])
    np.testing.assert_allclose(position.covariance, np.diag([0.01, 0.01, 0.09]))
    np.testing.assert_allclose(yaw.value, [0.5])
    np.testing.assert_allclose(yaw.covariance, [[0.0025]])


def test_a_velocity_and_a_position_without_height_are_read(tmp_path):
    path = tmp_path / "fixes.csv"
    path.write_text("t,kind,x,y,z,sx\n1,position,2,3,,0.5\n3, velocity,1,0,0,0.2\n")
    position, velocity = read_fixes(path)
    np.testing.assert_allclose(position.value, [2.0, 3.0, 0.0])
    np.testing.assert_allclose(position.covariance, np.diag([0.25, 0.25, 1e6]))
    assert velocity.kind == "velocity"


@pytest.mark.parametrize("by", [-100.0, 100.0])
def test_fixes_before_or_after_the_recording_are_on_another_clock(by):
    time, zero = np.arange(101) / 10.0, np.zeros((101, 3))
    sequence = ImuSequence("walk", time, zero, zero)
    fixes = [position_fix(at + by, np.zeros(3), np.eye(3)) for at in (2.0, 4.0)]
    with pytest.raises(InputError, match=r"fixes.*within"):
        check_within(fixes, sequence)
    check_within([*fixes, position_fix(5.0, np.zeros(3), np.eye(3))], sequence)


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


def test_a_level_walk_a_ramp_a_doorstep_and_two_seconds_are_one_floor():
    doorstep = [(30, 0, 1.2), (3, 0.6, 1.0), (30, 0, 1.2)]
    for legs in ([(300, 0.0, 1.2)], [(60, 2.0, 1.2)], doorstep, [(2, 0, 1.0)]):
        assert found(*legs) == ([], 0.0)
