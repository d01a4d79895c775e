import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from cut_windows import windows_of
from torch import nn

from stario.network.architectures import ARCHITECTURES, build_network
from stario.network.card import Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import load_model, save_model
from stario.network.runtime import engines
from stario.network.runtime.engines import (
    GRAPHS,
    Engine,
    Float32Array,
    OnnxEngine,
    weights_engine,
)
from stario.network.runtime.survey import random_windows
from stario.network.runtime.torch_engine import TorchEngine
from stario.network.stario import StarIO
from stario.sequences import STANDARD_GRAVITY, generate_walk, simulate_imu, world_streams


def randomise_norms(network: nn.Module) -> None:
    """Replace the initial parameters and statistics of every norm by random ones."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, 0.0, 0.5)
            module.running_mean.normal_(0.0, 0.5)
            module.running_var.uniform_(0.3, 2.0)


def randomised_network(seed: int = 0) -> DisplacementNetwork:
    """A StarIO whose norms, mu and xi all differ from their initial values."""
    torch.manual_seed(seed)
    network = DisplacementNetwork(StarIO())
    randomise_norms(network)
    for name, parameter in network.named_parameters():
        if name.endswith((".mu", ".xi")):
            nn.init.uniform_(parameter, -1.5, 1.5)
    return network.eval()


def engine_of(network: DisplacementNetwork) -> OnnxEngine:
    return weights_engine("StarIO", safetensors.torch.save(network.network.state_dict()))


@pytest.fixture(scope="module")
def network():
    return randomised_network()


@pytest.fixture(scope="module")
def engine(network):
    return engine_of(network)


def assert_same(engine: Engine, network: DisplacementNetwork, windows: Float32Array) -> None:
    with torch.inference_mode():
        expected = network(torch.from_numpy(windows))
    for a, b in zip(engine.run(windows), expected, strict=False):
        np.testing.assert_allclose(a, b.numpy(), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_graph_gives_what_the_network_gives(seed):
    network = randomised_network(seed)
    engine = engine_of(network)
    (stream,) = world_streams(simulate_imu(generate_walk(3, duration=8.0), seed=3))
    rest = np.zeros((2, 6, 200), np.float32)
    rest[0, 5] = STANDARD_GRAVITY
    batches = [random_windows(count) for count in (1, 2, 70)]
    for windows in (*batches, windows_of(stream, 20)[0], rest, 30.0 * random_windows(2)):
        assert_same(engine, network, windows)


def test_log_sigma_is_limited():
    network = randomised_network()
    head = network.network.head[-1]
    with torch.no_grad():
        head.bias[3:] = torch.tensor([-50.0, 0.0, 50.0])
    log_sigma = engine_of(network).run(random_windows(2))[1]
    assert (log_sigma[:, 0] == -6.0).all()
    assert (log_sigma[:, 2] == 3.0).all()


def test_the_packaged_graph_is_that_of_the_network():
    """The files that it serves are compared above; here its structure, after a change of either."""
    onnx = pytest.importorskip("onnx")
    from stario.network.runtime.stario_graph import stario_graph

    path = Path(engines.__file__).with_name(GRAPHS["StarIO"])
    packaged = onnx.load(path, load_external_data=False).graph
    built = stario_graph(StarIO()).graph
    assert list(packaged.node) == list(built.node)
    assert list(packaged.initializer) == list(built.initializer)
    external = [t for t in packaged.initializer if t.data_location == onnx.TensorProto.EXTERNAL]
    assert all(not t.raw_data for t in external)  # weights are stored once


@pytest.mark.parametrize("name", [name for name in ARCHITECTURES if name != "StarIO"])
def test_other_networks_run_in_pytorch_with_their_norms_folded(name):
    torch.manual_seed(0)
    network = DisplacementNetwork(build_network(name))
    with torch.no_grad():
        randomise_norms(network)
    assert_same(TorchEngine(network.eval()), network, random_windows(3))


def test_later_training_does_not_affect_an_engine():
    torch.manual_seed(0)
    network, windows = DisplacementNetwork(build_network("I-MobileNet")), random_windows(2)
    engine = TorchEngine(network)
    before = engine.run(windows)[0]
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(0.0)
    assert np.array_equal(engine.run(windows)[0], before)


def test_threads_do_not_affect_each_other(engine):
    batches = [random_windows(2) * np.float32(scale) for scale in (0.5, 1.0, 2.0, 3.0)]
    alone = [engine.run(batch)[0] for batch in batches]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: engine.run(batches[k % 4])[0], range(40)))
    assert all(np.array_equal(together[k], alone[k % 4]) for k in range(40))


def test_a_model_can_be_sent_to_another_process_and_trained_there():
    model, windows = load_model("default"), random_windows(2)
    sent = pickle.loads(pickle.dumps(model))
    assert np.array_equal(sent.predict(windows)[0], model.predict(windows)[0])
    assert_same(sent.engine, sent.training_form, windows)


@pytest.mark.parametrize("convert", [torch.Tensor.half, torch.Tensor.bfloat16])
def test_weights_in_another_number_format_run_in_pytorch(tmp_path, network, convert):
    small = randomised_network()
    for parameter in small.parameters():
        parameter.data = convert(parameter.data)
    save_model(tmp_path / "small.safetensors", small, Card("StarIO"))
    found = load_model(tmp_path / "small.safetensors").engine.run(random_windows(2))[0]
    expected = engine_of(network).run(random_windows(2))[0]
    np.testing.assert_allclose(found, expected, atol=0.05)


@pytest.mark.slow
def test_weights_and_commands_need_no_pytorch(tmp_path):
    """Importing it takes seconds and 200 MB."""
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from stario.fusion import demonstration\n"
        "from stario.fusion.commands.cli import main\n"
        "from stario.fusion.evaluation import results\n"
        "results.save_figure = lambda figure, path: path.touch()\n"  # rendering is slow
        "from stario.sequences.readers import write_csv\n"
        f"path = Path({str(tmp_path / 'walk.csv')!r})\n"
        "write_csv(path, demonstration().slice(0.0, 5.0))\n"
        "for command in ('inspect', 'compare'):\n"
        f"    sys.argv = ['stario', command, str(path), '--out', {str(tmp_path / 'out')!r}]\n"
        "    try:\n"
        "        main()\n"
        "    except SystemExit as end:\n"
        "        assert not end.code, (command, end.code)\n"
        "import stario.fusion.live.run\n"
        "sys.exit('imported torch' if 'torch' in sys.modules else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
