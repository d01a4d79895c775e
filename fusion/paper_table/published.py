"""Errors that the paper publishes, for comparison."""

from __future__ import annotations

from stario.network.architectures import ARCHITECTURES

_PUBLISHED = {
    "ronin": (
        (4.165, 8.103, 4.781, 4.755, 4.883, 4.077, 4.629, 4.374, 5.805, 4.471, 3.948),
        (3.724, 4.836, 3.705, 3.736, 3.713, 3.572, 3.681, 3.665, 4.276, 3.572, 3.554),
    ),
    "ridi": (
        (2.080, 3.839, 2.103, 2.486, 2.500, 2.290, 2.379, 2.047, 2.563, 2.118, 2.033),
        (2.383, 3.589, 2.445, 2.644, 2.584, 2.573, 2.406, 2.395, 2.929, 2.446, 2.274),
    ),
    "rnin": (
        (1.844, 3.182, 1.605, 2.174, 3.119, 3.142, 2.648, 2.478, 2.428, 1.250, 1.455),
        (1.836, 3.726, 1.593, 2.114, 1.568, 1.842, 1.613, 1.499, 1.979, 1.213, 1.370),
    ),
    "imunet": (
        (6.428, 8.108, 6.445, 9.130, 6.846, 8.593, 6.479, 6.918, 10.240, 6.577, 4.964),
        (4.802, 6.381, 4.463, 6.404, 4.809, 5.609, 4.458, 5.638, 5.735, 4.601, 3.815),
    ),
    "tlio": (
        (1.333, 2.145, 1.300, 1.354, 1.369, 1.373, 1.724, 1.258, 1.832, 1.254, 1.108),
        (3.705, 3.685, 3.627, 4.060, 0.842, 0.806, 0.959, 0.818, 5.162, 3.525, 3.145),
    ),
    "oxiod": (
        (4.336, 7.282, 2.780, 2.325, 2.381, 2.163, 1.982, 1.696, 3.855, 1.502, 1.484),
        (1.595, 2.301, 1.082, 1.135, 1.142, 1.103, 0.979, 1.100, 1.270, 0.878, 0.856),
    ),
}
"""ATE and RTE [m] published in the paper, by data set, in the order of `ARCHITECTURES`."""


def published(dataset: str, network: str) -> tuple[float, float] | None:
    """Return ATE and RTE [m] from the paper; None if it gives none."""
    if dataset not in _PUBLISHED or network not in ARCHITECTURES:
        return None
    ate, rte = _PUBLISHED[dataset]
    column = list(ARCHITECTURES).index(network)
    return ate[column], rte[column]
