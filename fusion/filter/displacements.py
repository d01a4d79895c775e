"""Updates with the network's displacements; what outliers mean, and what innovations tell.

README.md, "Displacement measurement" and "Gates".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stario.fusion.config import FilterConfig
from stario.fusion.filter.contradiction import (
    MAX_SECONDS,
    OFFSET_WALK,
    Contradiction,
    believed,
    is_nearer_offset,
)
from stario.fusion.filter.correlated_errors import displacement_errors
from stario.fusion.filter.ekf import Updated, update_displacement
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.innovations import InnovationStatistics
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.lie import yaw_rotation
from stario.sequences.accuracy.chi_square import chi2_quantile

_RARE_SHARE = 0.35
"""While less than this share of recent displacements were outliers, they are attributed to the
network; a filter that gates more of them may itself be wrong."""

_FITS = 0.95
"""Probability of the chi-square test beyond which a displacement does not fit as it is."""


class Displaced(NamedTuple):
    """What a displacement leaves behind."""

    ekf: EkfState
    contradiction: Contradiction | None
    statistics: InnovationStatistics
    result: UpdateResult
    """Outcome of the update with it."""
    fits: bool
    """Whether it is taken as it is."""
    revoked: tuple[float, ...]
    """Times of earlier displacements that were false [s]."""


def update_with(
    displacement: WindowDisplacement,
    s: EkfState,
    contradiction: Contradiction | None,
    statistics: InnovationStatistics,
    f: FilterConfig,
) -> Displaced:
    """Update with the displacement of the window that began at the oldest clone and ends now."""
    if contradiction is not None:
        return _while_contradicted(displacement, s, contradiction, statistics, f)
    after, result = _applied(s, displacement, statistics, f, f.gate, 1.0)
    updated = statistics.updated(result, f)
    if not result.gated or statistics.outlier_share >= _RARE_SHARE:
        return Displaced(after, None, updated, result, True, ())
    assert result.residual is not None  # it has been compared with the gate
    opened = s.with_offset_widened(float(result.residual @ result.residual))
    after, _ = _applied(opened, displacement, statistics, f)
    return Displaced(after, Contradiction((s.time,)), updated, result, False, ())


def _while_contradicted(
    displacement: WindowDisplacement,
    s: EkfState,
    contradiction: Contradiction,
    statistics: InnovationStatistics,
    f: FilterConfig,
) -> Displaced:
    """Take a displacement as it is if it fits so, else less the steady error."""
    after, result = _applied(s.without_offset(), displacement, statistics, f, _FITS, None)
    residual, updated = result.residual, statistics.updated(result, f)
    if residual is None:
        return Displaced(s, contradiction, updated, result, True, ())
    if result.accepted and not is_nearer_offset(s, residual):
        return Displaced(after, None, updated, result, True, contradiction.times)
    walked = s.with_offset_widened(OFFSET_WALK**2)
    after, result = _applied(walked, displacement, statistics, f, f.gate, None)
    if not result.accepted:  # the error has changed
        opened = s.with_offset_widened(float(residual @ residual))
        after, result = _applied(opened, displacement, statistics, f)
    times = (*contradiction.times, s.time)
    if s.time - times[0] > MAX_SECONDS:
        return Displaced(believed(after), None, updated, result, True, ())
    return Displaced(after, Contradiction(times), updated, result, False, ())


def _applied(
    s: EkfState,
    displacement: WindowDisplacement,
    statistics: InnovationStatistics,
    f: FilterConfig,
    gate: float | None = None,
    inflation: float | None = None,
) -> Updated:
    """Update a state with a displacement, in W."""
    d_N, covariance_N, R_NB = displacement
    slot = s.clone_slots[0]
    R_WN = yaw_rotation(s.clone_pose(slot)[0] @ R_NB.T)
    # Values that are not finite are rejected and counted by the filter.
    with np.errstate(invalid="ignore"):
        d_W, covariance_W = R_WN @ d_N, R_WN @ covariance_N @ R_WN.T
        errors = None
        if f.correlated_errors and np.isfinite(covariance_W).all():
            errors = displacement_errors(d_W, covariance_W, statistics.error_level, f)
        limit = None if gate is None else chi2_quantile(gate, 3)
        covariance_W = f.overlap_scale * covariance_W
        return update_displacement(s, slot, d_W, covariance_W, limit, inflation, errors)
