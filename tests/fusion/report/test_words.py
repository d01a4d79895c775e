"""Wording of the health report."""

from stario.fusion.report.health import findings, health_lines
from stario.fusion.state import Health


def warnings_of(health: Health) -> str:
    return " ".join(f.text + f.advice for f in findings(health) if f.level == "warning")


def test_small_innovations_are_not_reported_as_small_errors() -> None:
    (line,) = health_lines(Health(updates=100, mean_nis=0.8))[1:]
    assert "smaller" in line
    assert "safe side" not in line


def test_a_large_share_of_gated_fixes_is_a_warning() -> None:
    assert "frame" in warnings_of(Health(fixes={"applied": 3, "gated": 1}))
    assert not warnings_of(Health(fixes={"applied": 30, "gated": 1}))


def test_an_unusable_magnetic_field_is_reported() -> None:
    useless = Health(bearings={"no horizontal field": 120})
    assert any("magnetic field" in line for line in health_lines(useless))
    good = Health(bearings={"applied": 100, "gated": 90, "no horizontal field": 2})
    assert not any("magnetic field" in line for line in health_lines(good))


def test_standing_with_a_receiver_is_not_a_warning() -> None:
    standing = Health(fixes={"applied": 2, "yaw not known": 580})
    assert not warnings_of(standing)
    assert any("walked" in line for line in health_lines(standing))
