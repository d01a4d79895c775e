import torch

from stario.network.stario import moments, rms_normalised


def test_gradient_of_the_deviation_of_a_constant_is_finite() -> None:
    x = torch.full((2, 3, 5), 7.0, requires_grad=True)
    moments(x, dim=2)[1].sum().backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()


def test_moments_are_mean_and_deviation() -> None:
    x = torch.randn(4, 8, 50, generator=torch.Generator().manual_seed(0)) * 3.0 + 1.0
    mean, deviation = moments(x, dim=2)
    torch.testing.assert_close(mean, x.mean(2, keepdim=True))
    expected = x.std(2, correction=0, keepdim=True)
    torch.testing.assert_close(deviation, expected, rtol=1e-4, atol=0.0)


def test_normalised_windows_have_unit_mean_square_at_any_scale() -> None:
    x = torch.randn(3, 8, 50) * torch.tensor([0.1, 1.0, 1e4]).view(3, 1, 1)
    square = rms_normalised(x).square().mean(dim=(1, 2))
    torch.testing.assert_close(square, torch.ones(3), rtol=2e-3, atol=0.0)
