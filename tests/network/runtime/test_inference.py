import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from cut_windows import windows_of
from torch import Tensor, nn

from stario.network.architectures import ARCHITECTURES, build_network
from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.benchmark import network_speed
from stario.network.runtime.fast_stario import FastStarIO
from stario.network.runtime.inference import inference_form
from stario.network.stario import StarIO
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.simulation.imu import simulate_imu
from stario.sequences.simulation.walks import generate_walk
from stario.sequences.windows import world_streams


def randomise_norms(network: nn.Module) -> None:
    """Replace the initial parameters and statistics of every norm by random ones."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0.0, 0.5)
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(0.0, 0.5)
            module.running_var.uniform_(0.3, 2.0)


def randomised_network(gated_unit: bool = True, seed: int = 0) -> DisplacementNetwork:
    """A StarIO whose norms, mu and xi all differ from their initial values."""
    torch.manual_seed(seed)
    network = DisplacementNetwork(StarIO(gated_unit=gated_unit))
    randomise_norms(network)
    for name, parameter in network.named_parameters():
        if name.endswith((".mu", ".xi")):
            nn.init.uniform_(parameter, -1.5, 1.5)
    return network.eval()


def random_windows(batch: int) -> Tensor:
    windows = torch.randn(batch, 6, 200, generator=torch.Generator().manual_seed(batch))
    windows[:, 5] += STANDARD_GRAVITY
    return windows


@pytest.fixture(scope="module")
def walk_windows() -> Tensor:
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
    assert_same(randomised_network(gated_unit), random_windows(batch))


@pytest.mark.parametrize("seed", [1, 2])
def test_both_forms_agree_on_walks(walk_windows: Tensor, seed: int) -> None:
    assert_same(randomised_network(seed=seed), walk_windows)


def test_both_forms_agree_at_rest_and_under_violent_motion() -> None:
    rest = torch.zeros(1, 6, 200)
    rest[:, 5] = STANDARD_GRAVITY
    assert_same(
        randomised_network(), torch.cat([rest, 30.0 * random_windows(2), torch.zeros(1, 6, 200)])
    )


def test_both_forms_clamp_log_sigma() -> None:
    network = randomised_network()
    head = network.network.head[-1]  # type: ignore[index, union-attr]
    assert isinstance(head, nn.Linear)
    with torch.no_grad():
        head.bias[3:] = torch.tensor([-50.0, 0.0, 50.0])
        log_sigma = inference_form(network)(random_windows(2))[1]
    assert (log_sigma[:, 0] == -6.0).all()
    assert (log_sigma[:, 2] == 3.0).all()


def test_inference_does_not_modify_its_windows() -> None:
    windows = random_windows(3)
    before = windows.clone()
    with torch.inference_mode():
        inference_form(randomised_network())(windows)
    assert torch.equal(windows, before)


def test_later_training_does_not_affect_the_inference_form() -> None:
    network, windows = randomised_network(), random_windows(2)
    fast = inference_form(network)
    with torch.no_grad():
        before = fast(windows)[0].clone()
        for parameter in network.parameters():
            parameter.mul_(0.0)
        assert torch.equal(fast(windows)[0], before)


@pytest.mark.parametrize("name", [name for name in ARCHITECTURES if "StarIO" not in name])
def test_both_forms_of_every_other_network_agree(name: str) -> None:
    torch.manual_seed(0)
    network = DisplacementNetwork(build_network(name))
    with torch.no_grad():
        randomise_norms(network)
    assert_same(network.eval(), random_windows(3))


def test_results_do_not_depend_on_the_size_of_batches() -> None:
    network, windows = randomised_network(), random_windows(7)
    fast = inference_form(network)
    with torch.inference_mode():
        whole = fast(windows)[0]
        for sizes in ([1, 1, 1, 4], [2, 5], [3, 3, 1], [1, 6], [7]):
            parts = [fast(part)[0] for part in windows.split(sizes)]
            torch.testing.assert_close(torch.cat(parts), whole, rtol=0.0, atol=1e-5)


def test_buffers_are_kept_for_the_latest_sizes_of_batches_only() -> None:
    fast = inference_form(randomised_network())
    for size in (1, 2, 3, 4, 5, 1, 6):
        fast(random_windows(size))
    assert isinstance(fast.network, FastStarIO)
    assert list(fast.network._local.recordings) == [4, 5, 1, 6]


def test_a_result_is_not_overwritten_by_the_next_call() -> None:
    fast = inference_form(randomised_network())
    first = fast(random_windows(2))[0]
    kept = first.clone()
    fast(3.0 * random_windows(2))
    assert torch.equal(first, kept)


def test_threads_do_not_affect_each_other() -> None:
    fast = inference_form(randomised_network())
    batches = [random_windows(2) * scale for scale in (0.5, 1.0, 2.0, 3.0)]
    alone = [fast(batch)[0] for batch in batches]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: fast(batches[k % 4])[0], range(40)))
    assert all(torch.equal(together[k], alone[k % 4]) for k in range(40))


def test_the_inference_form_can_be_pickled() -> None:
    fast, windows = inference_form(randomised_network()), random_windows(2)
    expected = fast(windows)[0]
    assert torch.equal(pickle.loads(pickle.dumps(fast))(windows)[0], expected)


def test_speed_of_both_forms_is_measured_for_each_batch() -> None:
    speeds = network_speed(randomised_network(), batches=(1, 4), runs=2)
    assert [speed.batch for speed in speeds] == [1, 4]
    for speed in speeds:
        assert 0.0 < speed.inference_form_least <= speed.inference_form
        assert 0.0 < speed.training_form_least <= speed.training_form
