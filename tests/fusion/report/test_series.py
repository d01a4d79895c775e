"""What the report draws of a known track: units, standard deviations, ellipses, turns."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("plotly", reason="pip install '.[report]'")

from stario.fusion.report.panels import motion_panels
from stario.fusion.report.series import ellipse, track_series
from stario.fusion.values.state import Track
from stario.sequences.attitude.rotations import about_z
from stario.sequences.sequence import Trajectory

TIME = np.arange(0.0, 10.0, 0.1)
_POSE = (0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
SIGMA = np.array([*_POSE, 1e-3, 2e-3, 3e-3, 0.07, 0.08, 0.09])
"""Of rotation, velocity, position and both biases."""


def along_y(yaw: float = 0.0) -> Track:
    """A track at 1.5 m/s along y."""
    count = len(TIME)
    covariance = np.tile(np.diag(SIGMA**2), (count, 1, 1))
    covariance[:, 6, 7] = covariance[:, 7, 6] = 0.05
    trajectory = Trajectory(
        TIME,
        np.outer(TIME, [0.0, 1.5, 0.0]),
        about_z(np.full(count, yaw)),
        np.tile([0.0, 1.5, 0.0], (count, 1)),
        covariance[:, 6:9, 6:9],
    )
    b_g, b_a = np.full((count, 3), 0.01), np.full((count, 3), 0.2)
    return Track(trajectory, b_g=b_g, b_a=b_a, covariance=covariance)


def series_of(track: Track) -> pd.DataFrame:
    return track_series(track.trajectory, 0.0, track)


def test_columns_are_in_their_units_with_their_own_sigmas() -> None:
    series = series_of(along_y(yaw=0.5))
    for column, expected in {
        "yaw": np.degrees(0.5),
        "sigma yaw": np.degrees(0.03),
        "speed": 1.5,
        "sigma speed": 0.2,  # that of the velocity along the path
        "sigma z": 0.6,
        "xy": 0.05,
        "gyro x": np.degrees(0.01),
        "sigma gyro y": np.degrees(2e-3),
        "accel z": 0.2,
        "sigma accel z": 0.09,
    }.items():
        np.testing.assert_allclose(series[column], expected)


def test_speed_of_positions_alone_is_their_rate() -> None:
    positions = Trajectory(TIME, np.outer(TIME, [0.0, 1.5, 0.0]), Rotation.identity(len(TIME)))
    np.testing.assert_allclose(track_series(positions, 0.0).speed, 1.5)


def test_an_ellipse_is_where_the_mahalanobis_distance_is_three() -> None:
    outline = ellipse(4.0, 1.5, 1.0)
    weight = np.linalg.inv([[4.0, 1.5], [1.5, 1.0]])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", outline, weight, outline), 9.0)
    np.testing.assert_allclose(outline[0], outline[-1], atol=1e-10)


def test_yaws_on_both_sides_of_half_a_turn_are_drawn_next_to_each_other() -> None:
    shown = {
        name: track_series(along_y(np.radians(yaw)).trajectory, 0.0)
        for name, yaw in (("track", 179.0), ("filtered", -179.0))
    }
    yaw = {trace.name: trace.y for trace in motion_panels(shown, None)[2].traces if trace.name}
    np.testing.assert_allclose(
        np.subtract(yaw["filter, as in a stream"], yaw["StarIO"]), 2.0, atol=1e-3
    )


def test_the_band_of_a_line_is_three_sigma_wide() -> None:
    height = motion_panels({"track": series_of(along_y())}, None)[0]
    band, line = height.traces
    edge = np.asarray(band.y, dtype=float)
    assert np.nanmax(edge) == pytest.approx(3.0 * 0.6)
    assert np.nanmin(edge) == pytest.approx(-3.0 * 0.6)
    assert not any(line.y)


def turning(stop: float, offset: float) -> pd.DataFrame:
    """A device that turns by six degrees a second until `stop` [s], its yaw off by `offset` deg."""
    time = np.arange(0.0, stop, 0.1)
    return pd.DataFrame({"yaw": 6.0 * time + offset}, time).assign(x=0.0, y=0.0, z=0.0, speed=0.0)


@pytest.mark.parametrize("stop", [10.0, 120.0])
@pytest.mark.parametrize("turns", [0, 2])
def test_yaws_are_drawn_within_half_a_turn_of_the_truth_where_both_exist(
    stop: float, turns: int
) -> None:
    track = turning(stop, 5.0 + 360.0 * turns)
    panel = motion_panels({"track": track}, turning(120.0, 0.0))[-1]
    drawn = next(trace for trace in panel.traces if trace.legendgroup == "track")
    np.testing.assert_allclose(drawn.y, 6.0 * np.array(drawn.x) + 5.0, atol=1e-3)
