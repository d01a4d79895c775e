"""What a run says of itself in words."""

from stario.fusion.report.health import findings, health_lines
from stario.fusion.state import Health


def warned(health: Health) -> str:
    return " ".join(f.text + f.advice for f in findings(health) if f.level == "warning")


def test_small_innovations_promise_no_small_errors() -> None:
    (line,) = health_lines(Health(updates=100, mean_nis=0.8))[1:]
    assert "smaller" in line
    assert "safe side" not in line


def test_a_fix_far_off_is_no_fix_that_agrees() -> None:
    assert "frame" in warned(Health(fixes={"applied": 3, "gated": 1}))
    assert not warned(Health(fixes={"applied": 30, "gated": 1}))


def test_a_field_of_no_use_is_told() -> None:
    useless = Health(bearings={"no horizontal field": 120})
    assert any("magnetic field" in line for line in health_lines(useless))
    good = Health(bearings={"applied": 100, "gated": 90, "no horizontal field": 2})
    assert not any("magnetic field" in line for line in health_lines(good))


def test_who_stands_with_a_receiver_is_not_told_to_check_it() -> None:
    standing = Health(fixes={"applied": 2, "yaw not known": 580})
    assert not warned(standing)
    assert any("walked" in line for line in health_lines(standing))
