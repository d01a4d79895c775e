"""Updates with the network's displacements; what outliers mean, and what innovations tell.

README.md, "Displacement measurement" and "Gates".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stario.fusion.filter.alternative import AlternativeHypothesis, Hypotheses
from stario.fusion.filter.correlated_errors import displacement_errors
from stario.fusion.filter.ekf import Updated, update_displacement
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.innovations import InnovationStatistics
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.lie import yaw_rotation
from stario.fusion.values.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray

_RARE_SHARE, _RARE_POWER = 0.35, 4.0
"""While less than this share of recent displacements were outliers, they are attributed to the
network and inflated by this power of NIS / gate; a filter that gates more of them may itself be
wrong. This bridges about five seconds of false displacements."""

_OFFSET_GAIN = 0.5
"""Share of the latest outlier's residual in the alternative's offset, which may turn with the
device."""

_OFFSET_SCALE = 10.0
"""Factor on the covariance of a displacement less the offset, which comes from such residuals."""

_ALTERNATIVE_GATE = 0.95
"""Probability of the chi-square test beyond which a displacement does not fit the alternative."""


class Displaced(NamedTuple):
    """What a displacement leaves behind."""

    hypotheses: Hypotheses
    statistics: InnovationStatistics
    result: UpdateResult
    """Outcome in the filter."""
    rejected_later: tuple[float, ...]
    """Times of earlier displacements that were false after all [s]."""


def update_with(
    displacement: WindowDisplacement,
    before: Hypotheses,
    statistics: InnovationStatistics,
    f: FilterConfig,
) -> Displaced:
    """Update with the displacement of the window that began at the oldest clone and ends now."""
    rare = statistics.outlier_share < _RARE_SHARE
    power = _RARE_POWER if rare else 1.0
    ekf, result = _applied(before.ekf, displacement, statistics, f, f.gate, power)
    statistics = statistics.updated(result, f)
    if before.alternative is None and rare and result.gated:
        assert result.residual is not None  # it has been compared with the gate
        first = AlternativeHypothesis(before.ekf, result.residual, (before.ekf.time,))
        return Displaced(Hypotheses(ekf, first), statistics, result, ())
    if before.alternative is None or not result.accepted:
        return Displaced(changed(before, ekf=ekf), statistics, result, ())
    other, fits = _alternative_with(displacement, before.alternative, statistics, f)
    after, rejected_later = Hypotheses(ekf, other).judged(fits, not result.gated)
    return Displaced(after, statistics, result, rejected_later)


def _alternative_with(
    displacement: WindowDisplacement,
    before: AlternativeHypothesis,
    statistics: InnovationStatistics,
    f: FilterConfig,
) -> tuple[AlternativeHypothesis, bool]:
    """Update the alternative with a displacement: as it is if it fits, else less the offset.

    An alternative that is uncertain after some seconds would take any displacement for right, so
    one nearer to the offset than to zero does not fit.

    Return whether it fits, too.
    """
    ekf, result = _applied(before.ekf, displacement, statistics, f, _ALTERNATIVE_GATE, None)
    offset_W, residual = before.offset_W, result.residual
    if residual is None:
        return changed(before, ekf=ekf), True
    nearer_offset = residual @ offset_W > 0.5 * offset_W @ offset_W
    if result.accepted and not nearer_offset:
        return changed(before, ekf=ekf), True
    offset_W = offset_W + _OFFSET_GAIN * (residual - offset_W)
    ekf, _ = _applied(before.ekf, displacement, statistics, f, None, None, offset_W)
    outliers = (*before.outliers, before.ekf.time)
    return changed(before, ekf=ekf, offset_W=offset_W, outliers=outliers), False


def _applied(
    s: EkfState,
    displacement: WindowDisplacement,
    statistics: InnovationStatistics,
    f: FilterConfig,
    gate: float | None,
    inflation: float | None,
    offset_W: FloatArray | None = None,
) -> Updated:
    """Update a state with a displacement, in W and less an offset (3,) [m]."""
    d_N, covariance_N, R_NB = displacement
    slot = s.clone_slots[0]
    R_WN = yaw_rotation(s.clone_pose(slot)[0] @ R_NB.T)
    # Values that are not finite are rejected and counted by the filter.
    with np.errstate(invalid="ignore"):
        d_W, covariance_W = R_WN @ d_N, R_WN @ covariance_N @ R_WN.T
        if offset_W is not None:
            d_W, covariance_W = d_W - offset_W, _OFFSET_SCALE * covariance_W
        errors = None
        if f.correlated_errors and np.isfinite(covariance_W).all():
            errors = displacement_errors(d_W, covariance_W, statistics.error_level, f)
        limit = None if gate is None else chi2_quantile(gate, 3)
        covariance_W = f.overlap_scale * covariance_W
        return update_displacement(s, slot, d_W, covariance_W, limit, inflation, errors)
