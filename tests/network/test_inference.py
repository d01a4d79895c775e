import pytest
import torch
from torch import Tensor, nn

from stario.network.benchmark import network_speed
from stario.network.inference import inference_form
from stario.network.model import DisplacementNetwork
from stario.network.stario import StarIO
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.simulate import simulate_imu
from stario.sequences.walks import generate_walk
from stario.sequences.windows import windows_of, world_streams


def lived_in(gated_unit: bool = True, seed: int = 0) -> DisplacementNetwork:
    """A network whose every parameter and statistic differs from what it starts with."""
    torch.manual_seed(seed)
    network = DisplacementNetwork(StarIO(gated_unit=gated_unit))
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0.0, 0.5)
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(0.0, 0.5)
            module.running_var.uniform_(0.3, 2.0)
    for name, parameter in network.named_parameters():
        if name.endswith((".mu", ".xi")):
            nn.init.uniform_(parameter, -1.5, 1.5)
    return network.eval()


def random_windows(batch: int) -> Tensor:
    windows = torch.randn(batch, 6, 200, generator=torch.Generator().manual_seed(batch))
    windows[:, 5] += STANDARD_GRAVITY
    return windows


@pytest.fixture(scope="module")
def walked_windows() -> Tensor:
    (stream,) = world_streams(simulate_imu(generate_walk(3, duration=8.0), seed=3))
    return torch.from_numpy(windows_of(stream, 20)[0])


def assert_same(network: DisplacementNetwork, windows: Tensor) -> None:
    with torch.inference_mode():
        expected = network(windows)
        found = inference_form(network)(windows)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("batch", [1, 2, 64])
@pytest.mark.parametrize("gated_unit", [True, False])
def test_both_forms_agree_on_random_windows(batch: int, gated_unit: bool) -> None:
    assert_same(lived_in(gated_unit), random_windows(batch))


@pytest.mark.parametrize("seed", [1, 2])
def test_both_forms_agree_on_walks(walked_windows: Tensor, seed: int) -> None:
    assert_same(lived_in(seed=seed), walked_windows)


def test_both_forms_agree_at_rest_and_under_violence() -> None:
    rest = torch.zeros(1, 6, 200)
    rest[:, 5] = STANDARD_GRAVITY
    assert_same(lived_in(), torch.cat([rest, 30.0 * random_windows(2), torch.zeros(1, 6, 200)]))


def test_both_forms_clamp_log_sigma() -> None:
    network = lived_in()
    head = network.network.head[-1]  # type: ignore[index, union-attr]
    assert isinstance(head, nn.Linear)
    with torch.no_grad():
        head.bias[3:] = torch.tensor([-50.0, 0.0, 50.0])
        log_sigma = inference_form(network)(random_windows(2))[1]
    assert (log_sigma[:, 0] == -6.0).all()
    assert (log_sigma[:, 2] == 3.0).all()


def test_the_windows_are_left_as_they_are() -> None:
    windows = random_windows(3)
    before = windows.clone()
    with torch.inference_mode():
        inference_form(lived_in())(windows)
    assert torch.equal(windows, before)


def test_later_training_does_not_reach_the_inference_form() -> None:
    network, windows = lived_in(), random_windows(2)
    fast = inference_form(network)
    with torch.no_grad():
        before = fast(windows)[0].clone()
        for parameter in network.parameters():
            parameter.mul_(0.0)
        assert torch.equal(fast(windows)[0], before)


def test_an_unknown_network_stays_as_it_is_in_evaluation_mode() -> None:
    network = DisplacementNetwork(nn.Sequential(nn.Flatten(), nn.Dropout(), nn.Linear(1200, 6)))
    assert inference_form(network) is network
    assert not network.training


def test_speed_of_both_forms_is_measured_for_each_batch() -> None:
    speeds = network_speed(lived_in(), batches=(1, 4), runs=2)
    assert [speed.batch for speed in speeds] == [1, 4]
    for speed in speeds:
        assert 0.0 < speed.inference_form_least <= speed.inference_form
        assert 0.0 < speed.training_form_least <= speed.training_form
    with pytest.raises(InputError, match="at least 1"):
        network_speed(lived_in(), runs=0)


@pytest.mark.slow
def test_the_inference_form_is_the_faster_one() -> None:
    for speed in network_speed(lived_in(), runs=10):
        assert speed.inference_form_least < speed.training_form_least
