"""Chi-square quantiles, for gates and bounds, without the cost of `scipy.stats`."""

from __future__ import annotations

from functools import lru_cache

from scipy.special import gammaincinv


@lru_cache(maxsize=4096)
def chi2_quantile(probability: float, dof: float) -> float:
    """Return the chi-square quantile for a probability and `dof` degrees of freedom."""
    return float(2.0 * gammaincinv(0.5 * dof, probability))
