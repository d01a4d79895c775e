from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import InputError, ReadError, Trajectory, read_tum, write_tum


def track(n: int = 50, start: float = 0.0, seed: int = 1) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        time=start + np.cumsum(rng.uniform(0.005, 0.02, n)),
        position_W=rng.normal(0, 100, (n, 3)),
        attitude_WB=Rotation.random(n, rng=rng),
    )


@pytest.mark.parametrize("start", [0.0, 1.6e9])
def test_tum_round_trip(tmp_path, start):
    original = track(start=start)
    write_tum(tmp_path / "track.tum", original)
    found = read_tum(tmp_path / "track.tum")
    np.testing.assert_allclose(found.time, original.time, rtol=0, atol=1e-9 + start * 1e-15)
    np.testing.assert_allclose(found.position_W, original.position_W, rtol=0, atol=1e-9)
    turn = (found.attitude_WB * original.attitude_WB.inv()).magnitude()
    assert turn.max() < 5e-9


def test_tum_lines_are_what_other_tools_expect(tmp_path):
    path = tmp_path / "track.tum"
    upright = Rotation.from_quat([[0, 0, np.sin(0.5), np.cos(0.5)]] * 2)
    write_tum(path, Trajectory(np.array([0.0, 0.5]), np.array([[1, 2, 3], [4, 5, 6.0]]), upright))
    assert path.read_bytes().split(b"\n")[:2] == [
        b"0.000000000 1.000000000 2.000000000 3.000000000 "
        b"0.000000000 0.000000000 0.479425539 0.877582562",
        b"0.500000000 4.000000000 5.000000000 6.000000000 "
        b"0.000000000 0.000000000 0.479425539 0.877582562",
    ]


def test_tum_files_omit_invalid_poses(tmp_path):
    whole = track(10)
    valid = np.arange(10) % 3 != 0
    position = np.where(valid[:, None], whole.position_W, np.nan)
    write_tum(tmp_path / "t", replace(whole, position_W=position, valid=valid))
    assert len(read_tum(tmp_path / "t")) == valid.sum()
    with pytest.raises(InputError, match="no valid pose"):
        write_tum(tmp_path / "none", replace(whole, valid=np.arange(10) < 0))


GOOD = "{t} 1 2 3 0 0 0 1"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 1 2 3 0 0 0", r"line 4: found 7 values, expected 8: t x y z"),
        ("1,1,2,3,0,0,0,1", r"line 4: found 1 values"),
        ("1 1 two 3 0 0 0 1", r"line 4, y: found 'two'"),
        ("1 1 2 nan 0 0 0 1", r"line 4, z: found 'nan'"),
        ("0.5 1 2 3 0 0 0 1", r"line 4, t: found 0\.5 after 0\.5"),
        ("1 1 2 3 0 0 0 0", r"line 4, qx qy qz qw: found norm 0"),
    ],
)
def test_a_bad_tum_line_or_file_is_named(tmp_path, line, message):
    path = tmp_path / "track.tum"
    rows = ["# t x y z qx qy qz qw", "", GOOD.format(t=0.5), line, GOOD.format(t=2)]
    path.write_text("\n".join(rows))
    (tmp_path / "empty").write_text("# nothing\n")
    (tmp_path / "binary").write_bytes(b"\x80\x00\xff")
    for name in ("missing", "empty", "binary"):
        with pytest.raises(ReadError, match=f"{name}: (file|rows)"):
            read_tum(tmp_path / name)
    with pytest.raises(ReadError, match=f"{path}: {message}"):
        read_tum(path)
