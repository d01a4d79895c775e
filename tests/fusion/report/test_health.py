"""Findings of a run's health: which there are, how severe, and the numbers and advice in them."""

from __future__ import annotations

import pytest
from recorded import DATA
from told import health_verdict as findings

from stario.fusion import Health, Navigator
from stario.fusion.imu.gap import INTERPOLATED
from stario.network import load_model
from stario.sequences import read_recording
from stario.sequences.findings import Finding

BAGS = DATA / "raw" / "rosbag"
GOOD = {"samples": {"used": 1000}, "updates": 100, "mean_nis": 3.0}
SHAKEN = GOOD | {"samples": {"used": 2000}, "flagged": {"spike": 3, "saturated": 9}, "gated": 17}
GAPS = GOOD | {"gap_count": 3, "longest_gap": 0.3}
NOTHING = "nothing"


@pytest.mark.parametrize(
    ("health", "warned", "noted"),
    [
        (GOOD, [], NOTHING),
        (GOOD | {"samples": {"used": 900, "out_of_order": 100}}, ["samples_dropped"], ""),
        (GOOD | {"gated": 30}, ["network_contradicts"], ""),
        (GOOD | {"mean_nis": 9.0}, ["network_sigma"], ""),
        (GOOD | {"mean_nis": 0.8}, [], "network_sigma"),
        (GOOD | {"final_sigma": {"yaw_rad": 1.0}}, ["yaw_unknown"], ""),
        # After a few windows nothing is said about the motion, but rest is as good.
        ({"updates": 2, "gated": 2, "mean_nis": 0.04}, [], "too_early"),
        ({"zero_velocity": {"applied": 300}}, [], NOTHING),
        # A turn that is small, or perhaps by chance, is none.
        (GOOD | {"network_turn": -1.3, "network_turn_sigma": 0.1}, ["network_direction"], ""),
        (GOOD | {"network_turn": -1.3, "network_turn_sigma": 0.5}, [], NOTHING),
        (GOOD | {"network_turn": 0.3, "network_turn_sigma": 0.01}, [], NOTHING),
        (SHAKEN, ["samples_flagged", "network_contradicts"], ""),
        (SHAKEN | {"flagged": {"spike": 1}}, ["network_contradicts"], ""),
        (SHAKEN | {"gated": 3}, ["samples_flagged"], ""),
        (GOOD | {"fixes": {"applied": 3, "gated": 1}}, ["fixes"], ""),
        (GOOD | {"fixes": {"applied": 30, "gated": 1}}, [], "fixes"),
        # One stands with a receiver: two positions that are apart are still to come.
        (GOOD | {"fixes": {"applied": 2, "yaw not known": 580}}, [], "fixes"),
        (GOOD | {"bearings": {"no horizontal field": 120}}, [], "field_useless"),
        (GOOD | {"bearings": {"applied": 100, "gated": 90, "no horizontal field": 2}}, [], NOTHING),
        (
            GOOD | {"bearings": {"applied": 20, "contradicts the gyroscope": 8}},
            ["bearings_contradict"],
            "",
        ),
        (GOOD | {"bearings": {"applied": 3, "contradicts the gyroscope": 2}}, [], NOTHING),
        # The attitude is levelled within a second; it goes on where a gap is bridged.
        (GAPS | {"gaps": [(5.0, 0.25), (6.0, 0.25), (9.0, 0.3)]}, ["short_stretches"], "gaps"),
        (GAPS | {"gaps": [(5.0, 0.25), (7.0, 0.25)]}, [], "gaps"),
        (GAPS | {"gaps": [(5.0, 0.15), (5.6, 0.15), (6.2, 0.15)]}, [], "gaps"),
        (GAPS | {"longest_gap": 4.0}, ["gaps"], ""),
    ],
)
def test_what_stands_out_is_found_and_every_warning_has_advice(health, warned, noted) -> None:
    found = findings(Health(**health))
    warnings = [finding for finding in found if finding.level == "warning"]
    assert [finding.code for finding in warnings] == warned
    assert all(finding.advice for finding in warnings)
    assert all(noted != finding.code for finding in found) == (not noted)


def finding(code: str, **health: object) -> Finding:
    """The finding of a kind about a run that is good but for something."""
    (found,) = (each for each in findings(Health(**(GOOD | health))) if each.code == code)
    return found


@pytest.mark.parametrize(
    ("code", "health", "words"),
    [
        ("gaps", {"gap_count": 2, "longest_gap": 4.0}, "4.00 s"),
        ("samples_dropped", {"samples": {"used": 9999, "not finite": 1}}, "Fewer than 0.1%"),
        ("samples_dropped", {"samples": {"used": 900, "out_of_order": 100}}, "split the recording"),
        ("samples_dropped", {"samples": {"used": 900, "duplicate": 100}}, "the same rate"),
        ("samples_flagged", SHAKEN, "cannot be trusted"),
        ("samples_flagged", SHAKEN, "(3 spike, 9 saturated samples), and 17%"),
        ("network_contradicts", {"gated": 20}, "axes and signs are right, the weights"),
        (
            "network_direction",
            {"network_turn": -1.3, "network_turn_sigma": 0.1},
            "by -74 (+-6) degrees",
        ),
        ("network_sigma", {"mean_nis": 0.8}, "does not mean that the track's sigmas are too large"),
        ("network_sigma", {"mean_nis": 12.0}, "a factor of about 2.0"),
        ("fixes", {"fixes": {"applied": 3, "gated": 1}}, "frame"),
        ("fixes", {"fixes": {"applied": 2, "yaw not known": 580}}, "six times their sigma apart"),
        (
            "bearings_contradict",
            {"bearings": {"applied": 57, "contradicts the gyroscope": 56}},
            "56 of 113",
        ),
        ("yaw_unknown", {"final_sigma": {"yaw_rad": 0.5}}, "six times their sigma apart"),
    ],
)
def test_a_finding_says_what_was_counted_and_what_helps(code, health, words) -> None:
    assert words in str(finding(code, **health))


@pytest.mark.parametrize(
    ("gap", "yaw_sigma", "helps"),
    [(0.0, 0.5, True), (INTERPOLATED, 0.5, True), (4.0, 0.5, False), (0.0, 1.8, False)],
)
def test_standing_still_is_advised_only_where_the_yaw_drifts(gap, yaw_sigma, helps) -> None:
    found = finding("yaw_unknown", longest_gap=gap, final_sigma={"yaw_rad": yaw_sigma})
    assert ("still" in found.advice) == helps


def test_samples_late_for_a_moment_are_not_worth_a_note() -> None:
    late = [findings(Health(longest_late=seconds)) for seconds in (0.4, 0.6)]
    assert ["samples_late" in [f.code for f in found] for found in late] == [False, True]


@pytest.mark.skipif(not BAGS.is_dir(), reason=f"no recordings at {BAGS}")
def test_a_board_shaken_beyond_its_range_is_distrusted_and_one_turned_by_hand_is_not() -> None:
    """The first exceeds the 2 g of its accelerometer for seconds, the second stays within it."""
    navigator = Navigator(load_model("default"))
    shaken, turned = (
        navigator.run(read_recording(BAGS / name)).health
        for name in ("sparkfun_razor.bag", "phidgets_imu_upside_down.bag")
    )
    assert shaken is not None
    assert turned is not None
    assert "cannot be trusted" in " ".join(map(str, findings(shaken)))
    assert "trusted" not in " ".join(map(str, findings(turned)))
