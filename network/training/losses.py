"""The losses of full and of weak ground truth.

With full truth, the mean is learned by squared error throughout. Sigma joins later, through the
Gaussian likelihood e^2 / (2 sigma^2) + log sigma of the mean's current error (detached): the joint
likelihood, even weighted by sigma (Seitzer et al. 2022), starves the mean of gradient wherever
sigma is large, and the large errors dominate the error of a track.

Weak truth is positions without attitude, or waypoints. A stretch of levelled IMU is cut into
windows one second apart; the network's displacements d_k are chained along the gyroscope's yaw. A
leg m lies between two instants of known position, D_m apart. With a_mk the
time [s] shared by window k and leg m,

    D^_m = sum_k a_mk d_k,   psi = arg sum_m conj(D^_m) D_m / T_m,   r_m = exp(i psi) D^_m - D_m

(horizontal vectors as complex numbers). psi removes the unknown yaw between levelled frame and
map; no gradient flows through it. The known positions are uncertain, so the errors of neighbouring
legs have opposite signs: r is whitened by C = A diag(s^2) A' + q T, in which A maps positions to
legs, s is a position's standard deviation, T the diagonal of the legs' durations T_m and q the
variance that a second of displacement adds. A robust loss of the whitened residuals, times q, is
then on the scale of the windows' squared error.

psi leaves the direction of the displacements undetermined: a network trained on legs alone may
predict backward walking, which no track fitted in yaw reveals. The accelerometer determines it. The
mean velocities of two successive seconds differ by

    d_k+1 - d_k = integral of w(t) a(t) dt,   w rising from 0 to 1 and falling to 0 again,

and a, the specific force without gravity, is known in the frame of the displacements; its bias and
the levelling error hardly change within a stretch and are removed with the mean. The sum of two
successive integrals is a_k = d_k+2 - d_k. (From one second to the next, a walk sways with its
steps: a network trained from scratch on those changes predicted the sway correctly and still
predicted backward walking.) The angle of c = mean_k conj(d_k+2 - d_k) a_k is a stretch's direction
error. Its loss

    2 q / s_a^2 max(0, |c| / 2 - Re c - m),   m = rms |d_k+2 - d_k| rms |a_k| / 4,

is zero below 60 degrees and where chance could produce the angle; otherwise it is a part of what
turning the stretch would take from the mean of |d_k+2 - d_k - a_k|^2. With that whole mean as the
loss, a network that cannot predict every second shortens all of them (errors 10 % larger on Indoor
Location, held out).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from stario.network.training.legs import VARIANCE_RATE, LegBatch

SIGMA_WEIGHT = 0.05
"""Weight of the likelihood next to the squared error [m^2]: the square of a good error."""

VELOCITY_SIGMA = 0.1
"""Standard deviation per axis of the accelerometer's changes of velocity, s_a [m/s]."""

_COS_TURNED, _CHANCE = 0.5, 0.25
"""Cosine of the angle beyond which a stretch contradicts the accelerometer's direction, and the
correlation that chance produces among a dozen changes of velocity."""

_HUBER = 3.0
"""Whitened residuals beyond this many standard deviations count linearly."""


def loss_with_sigma(squared: Tensor, log_sigma: Tensor) -> Tensor:
    """Return the mean of squared errors (B, 3) [m^2] plus the weighted likelihood of sigma."""
    likelihood = 0.5 * squared.detach() * torch.exp(-2.0 * log_sigma) + log_sigma
    return (squared + SIGMA_WEIGHT * likelihood).sum(1).mean()


def leg_residuals(displacement_N: Tensor, legs: LegBatch) -> Tensor:
    """Return residuals (S, M, 3) [m] of displacements (S, K, 3) in N after a fit of the yaw."""
    predicted = torch.einsum("smk,skc->smc", legs.share, displacement_N)
    a, b = _complex(predicted), _complex(legs.displacement)
    weight = legs.known / legs.seconds
    psi = (weight * a.detach().conj() * b).sum(1, keepdim=True).angle()
    turned = torch.polar(torch.ones_like(psi), psi) * a - b
    vertical = predicted[..., 2] - legs.displacement[..., 2]
    return torch.stack([turned.real, turned.imag, vertical], dim=-1) * legs.known[..., None]


def _complex(vectors: Tensor) -> Tensor:
    """Return horizontal vectors (..., 2 or 3) as complex numbers (...)."""
    return torch.complex(vectors[..., 0], vectors[..., 1])


def leg_loss(displacement_H: Tensor, log_sigma_H: Tensor, legs: LegBatch) -> tuple[Tensor, Tensor]:
    """Return the loss of predictions (S, K, 3) [m] and log sigmas (S, K, 3) in the windows' frames.

    Returns:
        Robust whitened loss plus `direction_loss` and the weighted likelihood of the sigmas [m^2],
        as for windows with full truth; and the mean of |r|^2 / T [m^2/s], horizontal.
    """
    displacement_N = (legs.R_NH @ displacement_H[..., None])[..., 0]
    residual = leg_residuals(displacement_N, legs)
    count = legs.known.sum().clamp(min=1)
    white = torch.einsum("smn,snc->smc", legs.whitening, residual).norm(dim=-1)
    robust = 2.0 * F.huber_loss(white, torch.zeros_like(white), reduction="none", delta=_HUBER)
    loss = VARIANCE_RATE * (robust * legs.known).sum() / count
    variance = torch.exp(2.0 * log_sigma_H[..., :2]).mean(-1)
    total = torch.einsum("smk,sk->sm", legs.share, variance) + legs.variance
    squared = (residual.detach()[..., :2] ** 2).sum(-1)
    total = torch.where(legs.known, total, torch.ones_like(total))
    likelihood = ((0.5 * squared / total + total.log()) * legs.known).sum() / count
    plain = (squared / legs.seconds).sum() / count
    return loss + direction_loss(displacement_N, legs) + SIGMA_WEIGHT * likelihood, plain


def direction_loss(displacement_N: Tensor, legs: LegBatch) -> Tensor:
    """Return the loss of displacements (S, K, 3) in N that contradict the accelerometer [m^2]."""
    d, a = _complex(displacement_N[:, 2:] - displacement_N[:, :-2]), _complex(legs.velocity_change)
    c = (d.conj() * a).sum(1)
    # The small number keeps the gradient finite where nothing moves.
    size = (c.real**2 + c.imag**2 + 1e-12).sqrt()
    chance = _CHANCE * d.detach().norm(dim=1) * a.norm(dim=1)
    excess = 2.0 * (_COS_TURNED * size - c.real - chance).clamp(min=0.0) / a.shape[1]
    loss: Tensor = VARIANCE_RATE * excess.mean() / VELOCITY_SIGMA**2
    return loss
