"""The right-invariant error state: order, size and its relation to plain errors.

    theta [rad], rho_v [m/s], rho_p [m], d_bg [rad/s], d_ba [m/s^2] | theta, rho_p of each clone
    R = (I + [theta]x) R^,  v = v^ + rho_v - [v^]x theta,  p = p^ + rho_p - [p^]x theta

where ^ marks the estimate. Derivation: README.md, "Error state".
"""

from __future__ import annotations

import numpy as np

from stario.fusion.lie import FloatArray, skew

CORE = 15
"""Size of the error state of one navigation state."""

CLONE = 6
"""Size of the error state of one cloned pose."""


def plain_covariance(P: FloatArray, vectors_W: FloatArray) -> FloatArray:
    """Covariance of plain errors from that of invariant ones: v - v^ = rho_v - [v^]x theta.

    Args:
        P: (..., n, n) of theta, then a rho for each vector, then whatever does not change.
        vectors_W: (..., k, 3) velocity and position, or one of them; negative ones turn it back.
    """
    A = skew(vectors_W).reshape(*vectors_W.shape[:-2], -1, 3)
    stop = 3 + A.shape[-2]
    plain = P.copy()
    plain[..., 3:stop, :] -= A @ P[..., :3, :]
    plain[..., 3:stop] -= plain[..., :3] @ A.swapaxes(-1, -2)
    # Far from the origin the products' rounding would leave it asymmetric.
    return np.asarray(0.5 * (plain + plain.swapaxes(-1, -2)))
