"""Updates with the network's displacements; what outliers mean, and what innovations tell.

README.md, "Displacement measurement" and "Gates".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.alternative import AlternativeHypothesis, Hypotheses
from stario.fusion.filter.correlated_errors import displacement_errors
from stario.fusion.filter.ekf import Updated, update_displacement
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.innovations import InnovationStatistics
from stario.fusion.filter.jacobians import GAIN, REPORTED
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.lie import yaw_rotation
from stario.fusion.values.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile

_RARE_SHARE, _RARE_POWER = 0.35, 4.0
"""While less than this share of recent displacements were outliers, they are attributed to the
network and inflated by this power of NIS / gate; a filter that gates more of them may itself be
wrong. This bridges about five seconds of false displacements."""

_STEADY_SIGMA, _STEADY_WALK = 1.0, 0.28
"""Sigma of a steady error [m], and its random walk [m/sqrt(s)]: it may turn with the device."""

_RUN_SECONDS, _MAX_SECONDS = 5.0, 6.0
"""Mean and maximum duration of a run of false displacements [s]: an error that lasts longer is not
taken for false."""

_RUN_ODDS = 0.1
"""Prior odds that an outlier began such a run, and did not correct a filter that was wrong."""

_FALSE_DENSITY = 1e-3
"""Density of a displacement that fits nothing [1/m^3]: one in a hundred is anywhere in 10 m^3."""


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
    power = _RARE_POWER if statistics.outlier_share < _RARE_SHARE else 1.0
    ekf, result = _applied(before.ekf, displacement, statistics, f, f.gate, power=power)
    statistics = statistics.updated(result, f)
    if not result.accepted:
        return Displaced(changed(before, ekf=ekf), statistics, result, ())

    def honest(state: EkfState) -> Updated:
        """Update by the errors as they are: the gains assumed otherwise soon forget the speed."""
        return _applied(state, displacement, statistics, f, gains_from=REPORTED)

    if before.alternative is not None:
        after, rejected_later = _judged(before.alternative, ekf, result, honest, f)
        return Displaced(after, statistics, result, rejected_later)
    opened = None
    if result.gated:
        first, _ = honest(before.ekf.with_steady_error(_STEADY_SIGMA**2))
        opened = AlternativeHypothesis(first, (ekf.time,))
    return Displaced(Hypotheses(ekf, opened), statistics, result, ())


def _judged(
    other: AlternativeHypothesis,
    ekf: EkfState,
    result: UpdateResult,
    honest: Callable[[EkfState], Updated],
    f: FilterConfig,
) -> tuple[Hypotheses, tuple[float, ...]]:
    """Update the alternative; once the false displacements have ended, keep the likelier of both.

    Args:
        other: the alternative before a displacement.
        ekf: the filter after it.
        result: its outcome in the filter.
        honest: update with it.
        f: settings of the filter.

    Returns:
        Both, and the times of the displacements [s] that were false after all, since the
        alternative without them is adopted; empty otherwise.
    """
    lasting, if_lasting = honest(other.ekf.with_steady_error(_STEADY_WALK**2 / f.update_rate))
    ended, if_ended = honest(other.ekf.without_steady_error())
    end_odds = 1.0 / (_RUN_SECONDS * f.update_rate)
    if math.log(end_odds) + _evidence(if_ended) > _evidence(if_lasting):
        if math.log(_RUN_ODDS) + _evidence(if_ended) > _evidence(result):
            return Hypotheses(ended), other.false
        return Hypotheses(ekf), ()
    if ekf.time - other.false[0] > _MAX_SECONDS:
        return Hypotheses(ekf), ()
    return Hypotheses(ekf, AlternativeHypothesis(lasting, (*other.false, ekf.time))), ()


def _evidence(result: UpdateResult) -> float:
    """Return the logarithm of a displacement's probability density, which may be false anyway."""
    return float(np.logaddexp(result.log_likelihood, math.log(_FALSE_DENSITY)))


def _applied(
    s: EkfState,
    displacement: WindowDisplacement,
    statistics: InnovationStatistics,
    f: FilterConfig,
    gate: float | None = None,
    gains_from: int = GAIN,
    power: float = 1.0,
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
            level = statistics.error_level / statistics.excess  # which is in the covariance
            errors = displacement_errors(d_W, covariance_W, level, f)
        limit = None if gate is None else chi2_quantile(gate, 3)
        covariance_W = f.overlap_scale * covariance_W
        return update_displacement(s, slot, d_W, covariance_W, limit, errors, gains_from, power)
