"""Bounding boxes of paths [m], which determine the frame of a plan view and the tracks in it."""

from __future__ import annotations

import numpy as np

from stario.sequences.sequence import FloatArray


def box_of(path: FloatArray) -> FloatArray:
    """Return the corners (2, 2), lower left and upper right, of a path (n, 2)."""
    return np.array([np.nanmin(path, axis=0), np.nanmax(path, axis=0)])


def size_of(box: FloatArray) -> float:
    """Return the longer side of a box, at least 1 [m]."""
    return max(float(np.ptp(box, axis=0).max()), 1.0)


def excess(box: FloatArray, home: FloatArray) -> float:
    """Return how far [m] a box extends beyond another, in x or y."""
    return float(max((home[0] - box[0]).max(), (box[1] - home[1]).max(), 0.0))


def revisit_count(path: FloatArray, box: FloatArray) -> float:
    """Return a path's length over the size of its box: how often it revisits the same place."""
    return float(np.nansum(np.linalg.norm(np.diff(path, axis=0), axis=1))) / size_of(box)


def frame_around(boxes: FloatArray) -> FloatArray:
    """Return the corners (2, 2), lower left and upper right, of a frame around boxes (n, 2, 2)."""
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    half = np.maximum(0.5 * (high - low), 0.5) * 1.08
    half = np.maximum(half, 0.6 * half.max())  # even a straight path gets a frame of some width
    center = 0.5 * (low + high)
    return np.array([center - half, center + half])
