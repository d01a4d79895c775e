import pytest
from recorded import DATA
from told import health_verdict as findings

from stario.fusion import Health, Navigator
from stario.fusion.imu.gap import INTERPOLATED
from stario.network import load_model
from stario.sequences import read_recording

BAGS = DATA / "raw" / "rosbag"
GOOD = {"samples": {"used": 1000}, "updates": 100, "mean_nis": 3.0}
SHAKEN = GOOD | {"samples": {"used": 2000}, "flagged": {"spike": 3, "saturated": 9}, "gated": 17}
GAPS = GOOD | {"gap_count": 3, "longest_gap": 0.3}
TURNED = GOOD | {"network_turn": -1.3, "network_turn_sigma": 0.1}
NOTHING = "nothing"


@pytest.mark.parametrize(
    ("health", "warned", "noted", "words"),
    [
        (GOOD, [], NOTHING, ""),
        (GOOD | {"samples": {"used": 9999, "not finite": 1}}, [], "samples_dropped", "Fewer than"),
        (GOOD | {"samples": {"used": 900, "out_of_order": 100}}, ["samples_dropped"], "",
         "split the recording"),
        (GOOD | {"samples": {"used": 900, "duplicate": 100}}, ["samples_dropped"], "",
         "the same rate"),
        (GOOD | {"gated": 30}, ["network_contradicts"], "", "signs"),
        (GOOD | {"mean_nis": 12.0}, ["network_sigma"], "", "about 2.0"),
        (GOOD | {"mean_nis": 7.0, "network_error_level": 25.0}, ["network_sigma"], "", "5.0 times"),
        (GOOD | {"mean_nis": 0.8}, [], "network_sigma", "does not mean"),
        (GOOD | {"final_sigma": {"yaw_rad": 1.0}}, ["yaw_unknown"], "", "sigma apart"),
        (GOOD | {"longest_late": 0.4}, [], NOTHING, ""),
        (GOOD | {"longest_late": 0.6}, [], "samples_late", ""),
        # After a few windows nothing is said about the motion, but rest is as good.
        ({"updates": 2, "gated": 2, "mean_nis": 0.04}, [], "too_early", ""),
        ({"zero_velocity": {"applied": 300}}, [], NOTHING, ""),
        # A turn that is small, or perhaps by chance, is none.
        (TURNED, ["network_direction"], "", "by -74 (+-6) degrees"),
        (TURNED | {"network_turn_sigma": 0.5}, [], NOTHING, ""),
        (GOOD | {"network_turn": 0.3, "network_turn_sigma": 0.01}, [], NOTHING, ""),
        (SHAKEN, ["samples_flagged", "network_contradicts"], "",
         "cannot be trusted"),
        (SHAKEN | {"flagged": {"spike": 1}}, ["network_contradicts"], "", ""),
        (SHAKEN | {"gated": 3}, ["samples_flagged"], "", ""),
        (GOOD | {"fixes": {"applied": 3, "gated": 1}}, ["fixes"], "", "frame"),
        (GOOD | {"fixes": {"applied": 30, "gated": 1}}, [], "fixes", ""),
        (GOOD | {"fixes": {"applied": 5}, "fix_kinds": {"position": 4, "yaw": 1}}, [], "fixes",
         "5 fixes applied (given: 4 of position, 1 of yaw)."),
        # One stands with a receiver: two positions that are apart are still to come.
        (GOOD | {"fixes": {"applied": 2, "yaw not known": 580}}, [], "fixes", "sigma apart"),
        (GOOD | {"bearings": {"no horizontal field": 120}}, [], "field_useless", ""),
        (GOOD | {"bearings": {"applied": 100, "gated": 90, "no horizontal field": 2}}, [], NOTHING,
         ""),
        (GOOD | {"bearings": {"applied": 57, "contradicts the gyroscope": 56}},
         ["bearings_contradict"], "", "56 of 113"),
        (GOOD | {"bearings": {"applied": 3, "contradicts the gyroscope": 2}}, [], NOTHING, ""),
        # The attitude is levelled within a second; it goes on where a gap is bridged.
        (GAPS | {"gaps": [(5.0, 0.25), (6.0, 0.25), (9.0, 0.3)]}, ["short_stretches"], "gaps", ""),
        (GAPS | {"gaps": [(5.0, 0.25), (7.0, 0.25)]}, [], "gaps", ""),
        (GAPS | {"gaps": [(5.0, 0.15), (5.6, 0.15), (6.2, 0.15)]}, [], "gaps", ""),
        (GAPS | {"longest_gap": 4.0}, ["gaps"], "", "4.00 s"),
        (GOOD | {"corrections": [(93.2, 4.0, 0.5, "magnetic field")]}, ["corrections"], "",
         "4.0 m and 29 degrees at 93.2 s: magnetic field"),
    ],
)  # fmt: skip
def test_what_stands_out_is_found_and_every_warning_has_advice(health, warned, noted, words):
    found = findings(Health(**health))
    warnings = [finding for finding in found if finding.level == "warning"]
    assert [finding.code for finding in warnings] == warned
    assert all(finding.advice for finding in warnings)
    assert all(noted != finding.code for finding in found) == (not noted)
    assert words in " ".join(map(str, found))


@pytest.mark.parametrize(
    ("gap", "yaw_sigma", "helps"),
    [(0.0, 0.5, True), (INTERPOLATED, 0.5, True), (4.0, 0.5, False), (0.0, 1.8, False)],
)
def test_standing_still_is_advised_only_where_the_yaw_drifts(gap, yaw_sigma, helps) -> None:
    health = Health(**GOOD, longest_gap=gap, final_sigma={"yaw_rad": yaw_sigma})
    (found,) = (each for each in findings(health) if each.code == "yaw_unknown")
    assert ("still" in found.advice) == helps


@pytest.mark.slow
@pytest.mark.skipif(not BAGS.is_dir(), reason=f"no recordings at {BAGS}")
def test_a_board_shaken_beyond_its_range_is_distrusted_and_one_turned_by_hand_is_not() -> None:
    """The first exceeds the 2 g of its accelerometer for seconds, the second stays within it."""
    navigator = Navigator(load_model("default"))
    for name, distrusted in (("sparkfun_razor", True), ("phidgets_imu_upside_down", False)):
        recording = read_recording(BAGS / f"{name}.bag")
        start = recording.time[0]
        health = navigator.run(recording.slice(start, start + 20.0)).health
        assert ("cannot be trusted" in " ".join(map(str, findings(health)))) == distrusted
