from stario.sequences.drawing.text_table import aligned, figure


def test_columns_are_as_wide_as_their_widest_cell_with_space_between_them() -> None:
    lines = aligned([["", "ATE [m]", "n"], ["a walk", "1.5", "12"], ["b", "-", "3"]])
    assert lines == ["         ATE [m]    n", "a walk       1.5   12", "b              -    3"]


def test_unknown_values_are_shown_as_a_dash() -> None:
    assert [figure(None), figure(float("nan")), figure(0.0), figure(1.25, ".1f")] == [
        "-",
        "-",
        "0.000",
        "1.2",
    ]
