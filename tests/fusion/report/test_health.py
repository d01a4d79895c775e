"""Findings of the health report, their advice and their wording."""

from __future__ import annotations

from dataclasses import replace

import pytest
from recorded import DATA
from told import health_lines
from told import health_verdict as findings

from stario.fusion import Health, Navigator
from stario.fusion.health import SampleCounts
from stario.fusion.imu.gap import INTERPOLATED
from stario.network import load_model
from stario.sequences import read_recording

BAGS = DATA / "raw" / "rosbag"


def test_every_warning_comes_with_advice() -> None:
    good = findings(Health(samples={"used": 1000}, updates=100, mean_nis=3.0))
    assert [finding.level for finding in good] == ["good"]
    bad = findings(
        Health(
            samples={"used": 900, "out_of_order": 100},
            updates=100,
            gated=30,
            mean_nis=9.0,
            gap_count=2,
            longest_gap=4.0,
            final_sigma={"yaw_rad": 1.0},
        )
    )
    assert [finding.level for finding in bad] == ["warning"] * 5
    assert all(finding.advice for finding in bad)
    assert "4.00 s" in " ".join(finding.text for finding in bad)


def test_nothing_is_said_about_the_motion_after_a_few_windows() -> None:
    early = Health(updates=2, gated=2, mean_nis=0.04)
    assert [(f.level, "Too early" in f.text) for f in findings(early)] == [("note", True)]
    resting = findings(Health(zero_velocity={"applied": 300}))
    assert [finding.level for finding in resting] == ["good"]


SHAKEN = Health(
    samples={"used": 2000},
    flagged={"spike": 3, "saturated": 9},
    updates=60,
    gated=10,
    mean_nis=8.0,
)


def test_samples_late_for_a_moment_are_not_worth_a_note() -> None:
    late = [health_lines(SampleCounts(longest_late=s).health()) for s in (0.4, 0.6)]
    assert ["late for 0.6 s" in " ".join(lines) for lines in late] == [False, True]


def test_of_endless_gaps_the_newest_are_listed_and_all_are_counted() -> None:
    counts = SampleCounts()
    for k in range(150):
        counts.add_gap(float(k), 0.2)
    health = counts.health()
    assert health.gap_count == 150
    assert [start for start, _ in health.gaps] == [float(k) for k in range(50, 150)]


def test_one_dropped_sample_among_thousands_is_not_reported_as_none() -> None:
    (found,) = [
        finding.text
        for finding in findings(Health(samples={"used": 9999, "not finite": 1}, updates=100))
        if "dropped" in finding.text
    ]
    assert found == "Fewer than 0.1% of the samples were dropped (1 not finite)."


def test_advice_on_dropped_samples_fits_most_of_them() -> None:
    for reason, words in (("out_of_order", "split the recording"), ("duplicate", "the same rate")):
        (found,) = (f for f in findings(Health({"used": 900, reason: 100})) if "dropped" in f.text)
        assert words in found.advice


def test_a_track_is_distrusted_only_if_sensors_and_filter_both_warn() -> None:
    verdict = health_lines(SHAKEN)[0]
    assert verdict.startswith("! This track cannot be trusted")
    assert "3 spike, 9 saturated" in verdict
    assert "17%" in verdict
    for unremarkable in ({"flagged": {"spike": 1}}, {"gated": 3}):
        lines = health_lines(replace(SHAKEN, **unremarkable))
        assert not any("trusted" in line for line in lines)
        assert any(line.startswith("! ") for line in lines)


def warnings_of(health: Health) -> str:
    return " ".join(f.text + f.advice for f in findings(health) if f.level == "warning")


def test_displacements_that_contradict_the_imu_ask_for_its_axes_before_the_motion() -> None:
    found = warnings_of(Health(updates=100, gated=20, mean_nis=3.0))
    assert 0 < found.index("axes and signs") < found.index("motion")
    assert "stario train" not in found  # it needs a truth, which most users do not have


def test_a_network_that_walks_another_way_than_the_accelerometer_is_named() -> None:
    health = Health(updates=100, mean_nis=3.0, network_turn=-1.3, network_turn_sigma=0.1)
    assert "by -74 (+-6) degrees" in warnings_of(health)
    assert not warnings_of(replace(health, network_turn_sigma=0.5))  # perhaps by chance
    assert not warnings_of(replace(health, network_turn=0.3))


def test_small_innovations_are_not_reported_as_small_errors() -> None:
    (line,) = health_lines(Health(updates=100, mean_nis=0.8))[1:]
    assert "does not mean that the track's sigmas are too large" in line
    assert "safe side" not in line


@pytest.mark.parametrize(
    ("gap", "yaw_sigma", "helps"),
    [(0.0, 0.5, True), (INTERPOLATED, 0.5, True), (4.0, 0.5, False), (0.0, 1.8, False)],
)
def test_standing_still_is_advised_only_where_the_yaw_drifts(
    gap: float, yaw_sigma: float, helps: bool
) -> None:
    health = Health(updates=100, mean_nis=3.0, longest_gap=gap, final_sigma={"yaw_rad": yaw_sigma})
    advice = findings(health)[-1].advice
    assert "yaw fix" in advice
    assert "six times their sigma apart" in advice
    assert ("still" in advice) == helps


def test_a_large_share_of_gated_fixes_is_a_warning() -> None:
    assert "frame" in warnings_of(Health(fixes={"applied": 3, "gated": 1}))
    assert not warnings_of(Health(fixes={"applied": 30, "gated": 1}))


def test_an_unusable_magnetic_field_is_reported() -> None:
    useless = Health(bearings={"no horizontal field": 120})
    assert any("magnetic field" in line for line in health_lines(useless))
    good = Health(bearings={"applied": 100, "gated": 90, "no horizontal field": 2})
    assert not any("magnetic field" in line for line in health_lines(good))
    for used, against in ((20, 8), (57, 56)):
        health = Health(bearings={"applied": used, "contradicts the gyroscope": against})
        assert f"{against} of {used + against} bearings" in warnings_of(health)
    assert not warnings_of(Health(bearings={"applied": 2, "contradicts the gyroscope": 2}))


def test_standing_with_a_receiver_is_not_a_warning() -> None:
    standing = Health(fixes={"applied": 2, "yaw not known": 580})
    assert not warnings_of(standing)
    assert any("six times their sigma apart" in line for line in health_lines(standing))


@pytest.mark.skipif(not BAGS.is_dir(), reason=f"no recordings at {BAGS}")
def test_a_board_shaken_beyond_its_range_is_distrusted_and_one_turned_by_hand_is_not() -> None:
    """The first exceeds the 2 g of its accelerometer for seconds, the second stays within it."""
    navigator = Navigator(load_model("default"))
    shaken = navigator.run(read_recording(BAGS / "sparkfun_razor.bag")).health
    turned = navigator.run(read_recording(BAGS / "phidgets_imu_upside_down.bag")).health
    assert shaken is not None
    assert turned is not None
    assert any("cannot be trusted" in line for line in health_lines(shaken))
    assert not any("trusted" in line for line in health_lines(turned))


def test_the_factor_by_which_sigmas_are_too_small_is_the_root_of_the_ratio() -> None:
    assert "a factor of about 2.0" in warnings_of(Health(updates=100, mean_nis=12.0))


def test_stretches_too_short_to_level_the_attitude_are_named() -> None:
    health = Health(updates=100, mean_nis=3.0, gap_count=3, longest_gap=0.3)
    health.gaps = [(5.0, 0.25), (6.0, 0.25), (9.0, 0.3)]
    (short,) = [each for each in findings(health) if each.level == "warning"]
    assert short.text.startswith("1 of the stretches between gaps")
    health.gaps = [(5.0, 0.25), (7.0, 0.25)]
    assert all(each.level != "warning" for each in findings(health))
    health.gaps = [(5.0, 0.15), (5.6, 0.15), (6.2, 0.15)]  # bridged: the attitude goes on
    assert all(each.level != "warning" for each in findings(health))
