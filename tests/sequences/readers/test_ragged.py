"""Rows that lack cells, or have one too many, wherever they are: read, or refused by a line."""

import pytest
from csv_lines import write_lines
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stario.sequences.errors import ReadError
from stario.sequences.readers import read_recording

TITLES = ["gx [rad/s]", "gy [rad/s]", "gz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"]
ROWS = 40


def table(time_at: int) -> list[list[str]]:
    """Return titles and rows with the times in one of the seven columns."""
    rows = [["0.1", "0.2", "0.3", "1.0", "2.0", f"9.{k % 10}"] for k in range(ROWS)]
    lines = [list(TITLES), *rows]
    for k, line in enumerate(lines):
        line.insert(time_at, f"{0.01 * k:.2f}" if k else "t [s]")
    return lines


@given(
    time_at=st.integers(0, 6),
    row=st.integers(1, ROWS),
    kept=st.integers(0, 6),
    separator=st.sampled_from(",;\t"),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_a_row_that_lacks_cells_is_named(tmp_path, time_at, row, kept, separator):
    """The last one, cut short when the recorder was killed, is skipped."""
    lines = table(time_at)
    lines[row] = lines[row][:kept]
    text = [separator.join(line) for line in lines]
    path = tmp_path / "a.csv"
    if row == ROWS:
        path.write_text("\n".join(text))
    else:
        write_lines(path, *text)
    if row == ROWS or not kept:  # a blank line is none
        assert len(read_recording(path)) == ROWS - 1
    else:
        with pytest.raises(ReadError, match=rf"line {row + 1}: found {kept} values, expected 7"):
            read_recording(path)


@pytest.mark.parametrize("row", [1, ROWS // 2, ROWS])
def test_a_ragged_row_of_a_sensor_is_refused_within_and_skipped_at_an_end(tmp_path, row):
    """An app writes its first rows before all sensors have begun, and its last as it is killed."""
    for name in ("accelerometer", "gyroscope"):
        lines = [f"{0.01 * k:.2f},5.66,5.66,5.66" for k in range(ROWS)]
        if name == "gyroscope":
            lines[row - 1] = lines[row - 1].rsplit(",", 1)[0]
        write_lines(tmp_path / f"{name}.csv", "time [s],x,y,z", *lines)
    if row in (1, ROWS):
        assert len(read_recording(tmp_path)) == ROWS - 1
    else:
        with pytest.raises(ReadError, match=f"line {row + 1}"):
            read_recording(tmp_path)
