import numpy as np

from stario.network.training.result import calibrate
from stario.sequences.sequence import FloatArray

TRUE_SCALE = np.array([1.7, 1.7, 0.4])


def errors_and_log_sigmas(count: int = 20_000) -> tuple[FloatArray, FloatArray]:
    """Gaussian errors whose deviation is TRUE_SCALE times the network's sigma."""
    rng = np.random.default_rng(0)
    log_sigma = rng.uniform(np.log(0.1), np.log(1.0), (count, 3))
    return TRUE_SCALE * np.exp(log_sigma) * rng.standard_normal((count, 3)), log_sigma


def test_recovers_a_known_scale() -> None:
    np.testing.assert_allclose(calibrate(*errors_and_log_sigmas()).scale, TRUE_SCALE, rtol=0.02)


def test_recovers_a_network_that_understates_contrasts() -> None:
    rng = np.random.default_rng(1)
    log_sigma = rng.uniform(np.log(0.1), np.log(0.5), (20_000, 3))
    error = np.exp(1.5 * log_sigma) * rng.standard_normal(log_sigma.shape)
    calibration = calibrate(error, log_sigma)
    np.testing.assert_allclose(calibration.exponent, 1.5, atol=0.05)
    np.testing.assert_allclose(calibration.scale, 1.0, rtol=0.08)


def test_horizontal_axes_share_their_factor() -> None:
    error, log_sigma = errors_and_log_sigmas()
    x, y, _ = calibrate(error * [3.0, 1.0, 1.0], log_sigma).scale
    assert x == y


def test_a_few_outliers_do_not_determine_the_scale() -> None:
    error, log_sigma = errors_and_log_sigmas()
    error[::200] *= 1000.0
    np.testing.assert_allclose(calibrate(error, log_sigma).scale, TRUE_SCALE, rtol=0.15)


def test_a_sigma_that_is_wrong_way_round_is_ignored() -> None:
    """Its exponent would be negative: certain where errors are large."""
    error, log_sigma = errors_and_log_sigmas()
    found = calibrate(error, -log_sigma)
    np.testing.assert_allclose(found.exponent, 0.0, atol=1e-3)
    rms = np.sqrt(np.mean(np.minimum(error**2, 25.0 * np.square(found.scale)), axis=0))
    np.testing.assert_allclose(found.scale, rms, rtol=0.05)
