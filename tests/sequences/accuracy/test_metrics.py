import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences import InputError, Trajectory, about_z, align, evaluate_track
from stario.sequences.accuracy.nees import nees, nees_bounds, position_nees


def walk(duration: float = 100.0, rate: float = 20.0) -> Trajectory:
    t = np.arange(round(duration * rate) + 1) / rate
    position = np.stack([8 * np.sin(0.11 * t), 5 * np.sin(0.23 * t), 0.4 * np.sin(0.5 * t)], axis=1)
    tilt = Rotation.from_rotvec(np.stack([0.3 * np.sin(t), 0.2 * np.cos(t), 0 * t], axis=1))
    return Trajectory(t, position, about_z(0.7 + np.sin(0.2 * t)) * tilt)


def drifted(truth: Trajectory, seed: int = 3) -> Trajectory:
    """Ground truth plus a random-walk error in position and yaw that starts at zero."""
    rng = np.random.default_rng(seed)
    step = rng.normal(0, 0.02, (len(truth), 3))
    yaw = np.cumsum(rng.normal(0, 0.003, len(truth)))
    step[0], yaw = 0, yaw - yaw[0]
    return replace(
        truth,
        position_W=truth.position_W + np.cumsum(step, axis=0),
        attitude_WB=about_z(yaw) * truth.attitude_WB,
    )


def moved(track: Trajectory, yaw: float, shift: tuple[float, float, float]) -> Trajectory:
    turn = about_z(yaw)
    return replace(
        track,
        position_W=track.position_W @ turn.as_matrix().T + shift,
        attitude_WB=turn * track.attitude_WB,
    )


def evo_ape_rmse(estimate: Trajectory, truth: Trajectory, alignment: str) -> float:
    pytest.importorskip("evo")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # raised by evo's own imports
        from evo.core.metrics import APE, PoseRelation
        from evo.core.trajectory import PoseTrajectory3D

    def converted(track: Trajectory) -> PoseTrajectory3D:
        return PoseTrajectory3D(
            positions_xyz=track.position_W.copy(),
            orientations_quat_wxyz=np.roll(track.quat_xyzw, 1, axis=1),
            timestamps=track.time.copy(),
        )

    ours, theirs = converted(estimate), converted(truth)
    if alignment == "first":
        ours.align_origin(theirs)
    elif alignment == "yaw":
        ours.align(theirs)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((theirs, ours))
    return float(metric.get_all_statistics()["rmse"])


@pytest.mark.parametrize("alignment", ["none", "first", "yaw"])
def test_ate_agrees_with_evo(alignment):
    truth = walk()
    estimate = moved(drifted(truth), 0.4 if alignment != "yaw" else -2.4, (1.0, -2.0, 0.3))
    if alignment == "yaw":  # on a plane, Umeyama's rotation is about the vertical
        truth, estimate = (
            replace(track, position_W=track.position_W * [1, 1, 0]) for track in (truth, estimate)
        )
    found = evaluate_track(estimate, truth, alignment=alignment, horizontal=False).ate_m
    assert found == pytest.approx(evo_ape_rmse(estimate, truth, alignment), rel=1e-9)


@pytest.mark.parametrize("mode", ["none", "first", "yaw"])
def test_alignment_never_changes_the_tilt(mode):
    truth = walk()
    estimate = moved(drifted(truth), 1.0, (3.0, 2.0, 1.0))
    tilted = replace(estimate, attitude_WB=Rotation.from_rotvec([0.2, 0, 0]) * estimate.attitude_WB)
    aligned = align(tilted, truth, mode)
    np.testing.assert_allclose(
        aligned.attitude_WB.as_matrix()[:, 2], tilted.attitude_WB.as_matrix()[:, 2], atol=1e-10
    )
    np.testing.assert_allclose(
        np.diff(aligned.position_W[:, 2]), np.diff(tilted.position_W[:, 2]), atol=1e-10
    )


def test_first_alignment_matches_the_first_common_pose_and_rotates_velocity_and_covariance():
    truth = walk()
    covariance = np.broadcast_to(np.diag([4.0, 1.0, 9.0]), (len(truth), 3, 3))
    velocity = np.broadcast_to([1.0, 0.0, 0.5], (len(truth), 3))
    estimate = replace(truth, velocity_W=velocity, position_covariance_W=covariance)
    turned = moved(estimate, -np.pi / 2, (5.0, 0.0, 0.0))  # does not rotate velocity and covariance
    aligned = align(turned, truth, "first")
    np.testing.assert_allclose(aligned.position_W, truth.position_W, atol=1e-9)
    np.testing.assert_allclose(aligned.velocity_W[0], [0.0, 1.0, 0.5], atol=1e-10)
    np.testing.assert_allclose(
        aligned.position_covariance_W[0], np.diag([1.0, 4.0, 9.0]), atol=1e-10
    )
    truth = walk()
    late = replace(truth, valid=truth.time >= 10.0)
    estimate = moved(truth, 0.5, (1.0, 2.0, 3.0))
    bad_start = replace(estimate, valid=estimate.time >= 12.0)
    assert evaluate_track(bad_start, late).ate_m == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("alignment", ["none", "first", "yaw"])
def test_moving_both_tracks_leaves_the_errors_unchanged(alignment):
    truth = walk()
    estimate = drifted(truth)
    moved_tracks = [moved(track, 2.0, (100.0, -40.0, 7.0)) for track in (estimate, truth)]
    found = evaluate_track(*moved_tracks, alignment=alignment)
    expected = evaluate_track(estimate, truth, alignment=alignment)
    for name in ("ate_m", "rte_m", "pde", "aye_rad"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-7, abs=1e-9)


def straight(duration: float, speed: float = 1.5, rate: float = 20.0) -> Trajectory:
    t = np.arange(round(duration * rate) + 1) / rate
    position = np.stack([speed * t, 0 * t, 0 * t], axis=1)
    return Trajectory(t, position, Rotation.identity(len(t)))


def with_velocity_error(truth: Trajectory, error: tuple[float, float, float]) -> Trajectory:
    return replace(truth, position_W=truth.position_W + np.outer(truth.time, error))


@pytest.mark.parametrize(("duration", "scaled"), [(120.0, False), (60.0, False), (20.0, True)])
def test_a_constant_velocity_error_gives_the_analytic_errors(duration, scaled):
    truth = straight(duration)
    found = evaluate_track(with_velocity_error(truth, (0.03, 0.04, 0.12)), truth)
    assert found.rte_m == pytest.approx(0.05 * 60.0)  # also when scaled from a shorter track
    assert found.rte_scaled is scaled
    assert found.pde == pytest.approx(0.05 / 1.5)
    assert found.path_m == pytest.approx(1.5 * duration)
    assert found.ate_m == pytest.approx(0.05 * duration / np.sqrt(3), rel=0.01)
    assert found.aye_rad == pytest.approx(0.0, abs=1e-9)
    in_3d = evaluate_track(with_velocity_error(truth, (0.03, 0.04, 0.12)), truth, horizontal=False)
    assert in_3d.rte_m == pytest.approx(0.13 * 60.0)
    climb = with_velocity_error(straight(duration, speed=0.0), (3.0, 0.0, 4.0))
    for horizontal, speed in ((True, 3.0), (False, 5.0)):  # the path of what is compared
        path = evaluate_track(climb, climb, horizontal=horizontal).path_m
        assert path == pytest.approx(speed * duration)
    standing = straight(duration, speed=0.0)
    assert np.isnan(evaluate_track(standing, standing).pde)


def test_relative_error_ignores_a_constant_offset():
    truth = walk()
    late_jump = np.where(truth.time[:, None] > 5.0, 2.0, 0.0) * [1.0, 0.0, 0.0]
    found = evaluate_track(replace(truth, position_W=truth.position_W + late_jump), truth)
    # Only pairs that straddle the jump contain it: 5 s of the 40 s in which a pair can start.
    assert found.rte_m == pytest.approx(2.0 * np.sqrt(5.0 / 40.0), rel=0.01)
    assert found.ate_m == pytest.approx(2.0 * np.sqrt(95.0 / 100.0), rel=0.01)


def test_ronin_convention_divides_by_root_dimension_and_tlio_takes_the_mean():
    truth = walk()
    estimate = drifted(truth)
    rms = evaluate_track(estimate, truth)
    ronin = evaluate_track(estimate, truth, convention="ronin")
    mean = evaluate_track(estimate, truth, convention="mean")
    assert ronin.ate_m * np.sqrt(2) == pytest.approx(rms.ate_m)
    assert ronin.rte_m * np.sqrt(2) == pytest.approx(rms.rte_m)
    error = estimate.position_W - truth.position_W
    assert mean.ate_m == pytest.approx(np.linalg.norm(error[:, :2], axis=1).mean())
    assert (ronin.pde, ronin.aye_rad) == (rms.pde, rms.aye_rad)
    assert [m.convention for m in (rms, ronin, mean)] == ["rms", "ronin", "mean"]
    in_3d = [
        evaluate_track(estimate, truth, horizontal=False, convention=c).ate_m
        for c in ("rms", "ronin")
    ]
    assert in_3d[1] * np.sqrt(3) == pytest.approx(in_3d[0])


def test_yaw_error_is_wrapped():
    truth = straight(10.0)
    offset = about_z(np.where(truth.time < 5, 0.0, 2 * np.pi - 0.1))
    estimate = replace(truth, attitude_WB=offset * truth.attitude_WB)
    assert evaluate_track(estimate, truth).aye_rad == pytest.approx(0.1 * np.sqrt(0.5), rel=0.01)


def test_truth_is_not_interpolated_across_gaps_and_coverage_excludes_them():
    truth = walk(rate=100.0)
    gap = (truth.time > 40.0) & (truth.time < 60.0)
    wild = np.where((truth.time > 41)[:, None] & (truth.time < 59)[:, None], 1e3, 0.0)
    estimate = replace(truth, position_W=truth.position_W + wild)
    for gappy in (replace(truth, valid=~gap), truth.select(~gap)):
        found = evaluate_track(estimate, gappy)
        assert found.ate_m == pytest.approx(0.0, abs=1e-9)
        assert found.coverage == pytest.approx(0.8, abs=1e-3)
        assert found.duration_s == pytest.approx(100.0)


def test_relative_error_is_nan_if_a_gap_leaves_no_pair():
    truth = walk(duration=70.0)
    ends = (truth.time < 5.0) | (truth.time > 66.0)
    found = evaluate_track(replace(drifted(truth), valid=ends), truth)
    assert np.isnan(found.rte_m)
    coarse = walk().select(np.arange(2001) % 140 == 0)  # every 7 s: 63 s are not 60
    assert np.isnan(evaluate_track(coarse, walk()).rte_m)
    assert evaluate_track(coarse, walk(), rte_interval=63.0).rte_m < 1e-9
    even, odd = (evaluate_track(drifted(walk()), walk(), rte_interval=s) for s in (60.0, 60.01))
    assert odd.rte_m == pytest.approx(even.rte_m, rel=0.01)  # with the nearest sample
    assert not found.rte_scaled
    assert found.ate_m > 0


def test_no_overlap_is_an_error_that_names_both_spans():
    truth = straight(10.0)
    later = replace(truth, time=truth.time + 100.0)
    with pytest.raises(InputError, match=r"overlap: 100.* against truth 0"):
        evaluate_track(later, truth)


def gaussian_samples(n: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(11)
    factor = rng.normal(size=(n, 3, 3)) + 2 * np.eye(3)
    error = np.einsum("nij,nj->ni", factor, rng.normal(size=(n, 3)))
    return scale * error, factor @ factor.transpose(0, 2, 1)


def test_nees_of_gaussian_samples_lies_within_bounds_of_the_stated_share():
    low, high = nees_bounds(3, 500, confidence=0.999)
    assert low < nees(*gaussian_samples(500)).mean() < high
    assert nees(*gaussian_samples(500, scale=1.3)).mean() > high
    assert nees(*gaussian_samples(500, scale=0.7)).mean() < low
    rng = np.random.default_rng(5)
    means = (rng.normal(size=(4000, 20, 3)) ** 2).sum(axis=2).mean(axis=1)
    low, high = nees_bounds(3, 20)
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.015)


def test_position_nees_skips_a_start_without_covariance_and_is_yaw_invariant():
    truth = walk(duration=100.0)
    error, covariance = gaussian_samples(len(truth))
    error[0], covariance[0] = 0, 0
    estimate = replace(truth, position_W=truth.position_W + error, position_covariance_W=covariance)
    found = position_nees(estimate, truth)
    assert len(found.nees) == len(truth) - 1
    low, high = nees_bounds(3, len(found.nees), confidence=0.999)
    assert low < found.mean < high
    assert found.median == pytest.approx(2.37, abs=0.25)  # of chi-square, 3 degrees of freedom
    # Rotating the frame must rotate the covariance with it.
    turn = about_z(0.9).as_matrix()
    other = moved(estimate, 0.9, (1, 2, 3))
    other = replace(other, position_covariance_W=turn @ covariance @ turn.T)
    np.testing.assert_allclose(position_nees(other, truth).nees, found.nees, rtol=1e-6)


@pytest.mark.parametrize("poses", [1, 600])
def test_yaw_alignment_of_a_stationary_track_uses_its_attitudes(poses):
    """Millimetre noise in the positions would give an arbitrary yaw; the attitudes do not."""
    rng = np.random.default_rng(0)
    time = np.arange(poses) / 10.0
    about = np.linspace(0.0, 2.0 * np.pi, poses)
    truth = Trajectory(time, 1e-3 * rng.normal(size=(poses, 3)), about_z(about))
    if poses == 1:
        truth = Trajectory(np.array([0.0, 0.05]), np.zeros((2, 3)), about_z(np.zeros(2)))
    turned = about_z(np.full(poses, 3.0)) * truth.attitude_WB[:poses]
    estimate = Trajectory(time, 1e-3 * rng.normal(size=(poses, 3)), turned)
    found = evaluate_track(estimate, truth, alignment="yaw")
    assert found.aye_rad < 1e-9
    assert found.ate_m < 3e-3
    moving = replace(truth, position_W=np.outer(truth.time, [1.0, 0.5, 0.0]))
    assert evaluate_track(estimate, moving, alignment="yaw").aye_rad < 1e-9
