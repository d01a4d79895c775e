"""Plan view of tracks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from stario.sequences.drawing.boxes import box_of, excess, frame_around, revisit_count, size_of
from stario.sequences.drawing.figures import (
    INK,
    LEGEND,
    RED,
    distance,
    draw_path,
    indices_after_gaps,
    new_figure,
    panels_of,
    split_at_gaps,
    style_of,
)
from stario.sequences.errors import InputError
from stario.sequences.sequence import PositionTrack, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CROWDED = 12.0
"""Revisit count above which lines are drawn thinner."""

_MARKED_GAP = 1.0
"""Length of a gap [s] above which the track's next pose is marked."""


def plan_view(
    tracks: Mapping[str, Trajectory],
    truth: Trajectory | None,
    title: str,
    known: PositionTrack | None = None,
) -> Figure:
    """Draw all tracks from above, on equal axes that fit the ground truth and the tracks near it.

    A track that drifts far beyond these is cut at the frame, and the legend states how far it goes.
    Invalid poses and gaps appear as breaks; the first pose after a gap of more than a second is
    marked. Tracks are drawn as given: align them first.

    Args:
        tracks: tracks by name; "inertial", "pdr", "network", "network_true_attitude", "ekf" and
            "graph" have fixed colours.
        truth: the true track in the same frame, or None.
        title: title of the figure.
        known: positions or waypoints (n, 2) in the same frame, if there is no true track.

    Raises:
        InputError: there is nothing to draw.
    """
    paths = {
        name: split_at_gaps(t.time, t.position_W[:, :2], t.valid)[1] for name, t in tracks.items()
    }
    path_truth = (
        None if truth is None else split_at_gaps(truth.time, truth.position_W[:, :2], truth.valid)
    )
    boxes = {name: box_of(path) for name, path in paths.items() if np.isfinite(path).any()}
    if path_truth is not None and np.isfinite(path_truth[1]).any():
        typical = path_truth[1]
    elif boxes:
        # Drift only makes a track larger, so the lower median is a track without large drift.
        by_size = sorted(boxes, key=lambda name: size_of(boxes[name]))
        typical = paths[by_size[(len(boxes) - 1) // 2]]
    else:
        raise InputError("tracks", "no valid pose", "at least one track to draw")
    home = box_of(typical)
    near = [box for box in boxes.values() if excess(box, home) <= 0.5 * size_of(home)]
    if known is not None:
        near.append(box_of(known.position_W))
    frame = frame_around(np.array([home, *near]))
    width, height = np.ptp(frame, axis=0) / np.ptp(frame, axis=0).max()
    fig = new_figure(7.0 * max(width, 0.85) + 1.0, 7.0 * height + 1.5, title)
    (axes,) = panels_of(fig)
    fine = 0.6 if revisit_count(typical, home) > _CROWDED else 1.0
    if path_truth is not None:
        draw_path(axes, path_truth[1], "truth", "black", width=2.2 * fine, order=2)
    for k, (name, box) in enumerate(boxes.items()):
        label, colour = style_of(name, k)
        far = excess(box, home)
        if far > 0.5 * size_of(home):
            label += f" (leaves the figure by {distance(far)})"
        draw_path(axes, paths[name], label, colour, width=1.3 * fine, order=3)
    _mark_gaps(axes, tracks)
    if known is not None:
        size = 7.0 if known.kind == "waypoints" else 3.0
        label = f"{known.kind}, fitted"
        x, y = known.position_W.T
        axes.plot(x, y, "x", color="black", ms=size, mew=1.6, label=label, zorder=4)
    axes.set(xlim=frame[:, 0], ylim=frame[:, 1], xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.plot([], [], "o", mfc="white", mec=INK, label="start")
    axes.plot([], [], "s", mfc=INK, mec="white", label="end")
    fig.legend(loc="outside lower center", ncols=3, **LEGEND)
    return fig


def _mark_gaps(axes: Axes, tracks: Mapping[str, Trajectory]) -> None:
    """Mark where each track continues after a gap, during which its direction is unknown."""
    label = "after a gap"
    for name, track in tracks.items():
        if name == "pdr":  # it has no poses while the person stands
            continue
        after = indices_after_gaps(track.time, _MARKED_GAP)
        if len(after):
            x, y = track.position_W[after, :2].T
            axes.plot(x, y, "D", mfc="none", mec=RED, ms=7, label=label, zorder=4)
            label = ""
