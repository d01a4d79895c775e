"""The head of a text file's table: separator, decimal mark, titles, dates."""

from pathlib import Path

import pytest

from stario.sequences.readers.table_head import TableHead, first_row, table_heads
from stario.sequences.readers.text import RowFormat


def head_of(folder: Path, *lines: str) -> TableHead:
    file = folder / "table.csv"
    file.write_text("\n".join(lines))
    *_, last = table_heads(file)
    return last


def test_a_first_row_of_integers_has_the_decimal_mark_of_the_rows_below():
    rows = ["Zeit;x;y;z", "0;0;0;0", "0,01;0,5;-0,25;9,8", "0,02;0,5;-0,25;9,8"]
    assert first_row(rows) == RowFormat(1, ";", ",")
    points = [row.replace(",", ".") for row in rows]
    assert first_row(points) == RowFormat(1, ";", ".")


def test_words_above_rows_with_blanks_are_no_titles(tmp_path):
    assert head_of(tmp_path, "made by a logger on a phone", "0 1 2 3", "1 1 2 3").titles == []
    assert head_of(tmp_path, "t x y z", "0 1 2 3", "1 1 2 3").titles == ["t", "x", "y", "z"]


def test_titles_may_be_separated_in_another_way_than_the_rows(tmp_path):
    """As NumPy's `savetxt` does: without its titles, columns z, y, x would be read as x, y, z."""
    assert head_of(tmp_path, "# time,z,y,x", "0 1 2 3", "1 1 2 3").titles == ["time", "z", "y", "x"]


@pytest.mark.parametrize(
    "between",
    [
        ("0,,,", "1,,,"),
        ("0,NaN,NaN,NaN",),
        ("0,null,,1",),
        ("Started 12:00",),
        ("# walk",),
        ("int64,float,float,float",),
    ],
)
def test_incomplete_rows_and_remarks_may_follow_the_titles(tmp_path, between):
    """Without its titles, columns z, y, x would be read as x, y, z."""
    head = head_of(tmp_path, "by a logger", "time,z,y,x", *between, "2,1,2,3", "3,1,2,3")
    assert head.titles == ["time", "z", "y", "x"]
    assert head.row_format.skip == 2 + len(between)


def test_incomplete_rows_without_titles_are_none(tmp_path):
    assert head_of(tmp_path, "0,,,", "2,1,2,3", "3,1,2,3").titles == []
