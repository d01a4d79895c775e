import pytest
import torch
from torch import nn

from stario.network.architectures import ARCHITECTURES, build_network
from stario.network.baselines.networks import NoiseLayer, Rnin


def windows(count: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, 6, 200, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_output_has_one_row_per_window_independent_of_other_windows(name):
    torch.manual_seed(0)
    network = build_network(name).eval()
    batch = windows(3)
    batch[:2] *= 1e3
    with torch.inference_mode():
        alone, together = network(batch[2:]), network(batch)
    assert together.shape == (3, 6)
    torch.testing.assert_close(together[2:], alone, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_every_gradient_is_nonzero_and_finite_even_with_a_constant_window(name):
    torch.manual_seed(0)
    network = build_network(name)
    for module in network.modules():
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    batch = torch.cat([windows(3), torch.zeros(1, 6, 200)])
    # Recurrent weights act only on a nonzero state, that is in a series of windows.
    network(batch.unflatten(0, (2, 2)) if name == "RNIN" else batch).square().sum().backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key
        assert (parameter.grad != 0.0).any(), key


@pytest.mark.parametrize("name", ["TLIO", "RNIN"])
def test_the_two_heads_are_trained_separately(name):
    network = build_network(name)
    network(windows(4))[:, :3].square().sum().backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None
        if key.startswith(("mean.", "log_sigma.")):
            assert bool((parameter.grad != 0.0).any()) == key.startswith("mean."), key


def test_rnin_gives_the_same_for_a_series_at_once_and_step_by_step():
    torch.manual_seed(0)
    rnin = Rnin().eval()
    series = windows(2 * 5).unflatten(0, (2, 5))
    with torch.inference_mode():
        at_once = rnin(series)
        state = None
        for k in range(5):
            outputs, state = rnin.step(series[:, k], state)
            torch.testing.assert_close(outputs, at_once[:, k], rtol=1e-4, atol=1e-6)


def test_the_noise_layer_subtracts_a_weighted_copy_of_the_raw_window():
    layer = NoiseLayer(4)
    features, raw = torch.randn(3, 4), torch.randn(3, 4)
    with torch.no_grad():
        layer.bias.fill_(0.5)
        torch.testing.assert_close(layer(features, raw), features - layer.weight * raw + 0.5)
