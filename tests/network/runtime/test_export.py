from importlib.util import find_spec

import numpy as np
import onnxruntime as ort
import pytest
import torch
from training_runs import shallow

from stario.network.architectures import ARCHITECTURES, build_network
from stario.network.card import Calibration, Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import DisplacementModel, load_model, save_model
from stario.network.runtime.export import export_onnx
from stario.network.runtime.survey import random_windows
from stario.network.runtime.torch_engine import TorchEngine
from stario.sequences.errors import InputError, WeightsError
from stario.sequences.sequence import FloatArray

# Not imported here: that takes longer than to collect all other tests of networks.
pytestmark = pytest.mark.skipif(
    not (find_spec("onnx") and find_spec("onnxscript")), reason="needs the extra onnx"
)

CALIBRATION = Calibration((1.5, 1.5, 0.7), (1.2, 1.2, 0.9), (0.02, 0.02, 0.01))


def untrained(name: str) -> DisplacementModel:
    torch.manual_seed(0)
    return DisplacementModel(
        TorchEngine(DisplacementNetwork(build_network(name))), Card(name, calibration=CALIBRATION)
    )


def assert_close(found: FloatArray, expected: FloatArray) -> None:
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def shallow_rnin() -> DisplacementModel:
    with pytest.MonkeyPatch.context() as patch:
        shallow(patch)
        return untrained("RNIN")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """StarIO's file; those of others are traced, which takes a quarter of a minute."""
    path = tmp_path_factory.mktemp("export") / "stario.onnx"
    export_onnx(untrained("StarIO"), path)
    return path


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "rnin.onnx"
    export_onnx(shallow_rnin(), path)
    return path


@pytest.mark.parametrize(
    "name",
    [
        name if name.startswith("StarIO") else pytest.param(name, marks=pytest.mark.slow)
        for name in ARCHITECTURES
    ],
)
def test_an_exported_network_gives_the_same_predictions(name, tmp_path):
    model, path = untrained(name), tmp_path / "model.onnx"
    export_onnx(model, path)
    exported = load_model(path)
    assert exported.card.calibration == CALIBRATION
    assert exported.name == name
    for count in (1, 3, 70):
        windows = random_windows(count)
        for found, expected in zip(exported.predict(windows), model.predict(windows), strict=True):
            assert_close(found, expected)


@pytest.mark.slow
def test_a_recurrent_network_keeps_its_state_in_both_engines(recurrent):
    windows, model = random_windows(6), shallow_rnin()
    for found, expected in zip(
        load_model(recurrent).predict_next(windows, 2)[:2],
        model.predict_next(windows, 2)[:2],
        strict=True,
    ):
        assert_close(found, expected)
    assert_close(load_model(recurrent).predict(windows)[0], model.predict(windows)[0])


@pytest.mark.parametrize(
    ("file", "network", "more"),
    [
        ("exported", "StarIO", []),
        pytest.param("recurrent", "RNIN", [("state", [2, "batch", 256])], marks=pytest.mark.slow),
    ],
)
def test_the_exported_file_describes_its_inputs_and_outputs(request, file, network, more):
    exported = request.getfixturevalue(file)
    session = ort.InferenceSession(exported)
    inputs = [(n.name, n.shape) for n in session.get_inputs()]
    assert inputs == [("windows", ["batch", 6, 200]), *more]
    metadata = session.get_modelmeta().custom_metadata_map
    assert "200 Hz" in metadata["windows"]
    assert "[m]" in metadata["displacement"]
    assert metadata["frame"] == load_model(exported).card.frame
    assert f'"architecture": "{network}"' in metadata["stario_card"]


def test_truncated_absent_and_foreign_files_are_refused(exported, tmp_path):
    import onnx

    (tmp_path / "cut.onnx").write_bytes(exported.read_bytes()[:1000])
    converted, foreign = onnx.load(exported), onnx.load(exported)
    converted.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save(converted, tmp_path / "converted.onnx")
    del foreign.metadata_props[:]
    onnx.save(foreign, tmp_path / "foreign.onnx")
    for name, words in (
        ("cut", "graph"),
        ("absent", "file"),
        ("converted", r"windows: .*\[1, 6, 200\]"),
        ("foreign", "stario_card"),
    ):
        with pytest.raises(WeightsError, match=rf"{name}\.onnx: {words}"):
            load_model(tmp_path / f"{name}.onnx")


def test_an_exported_model_cannot_be_exported_again(exported, tmp_path):
    with pytest.raises(InputError, match="an exported graph"):
        export_onnx(load_model(exported), tmp_path / "again.onnx")


def test_a_recurrent_model_depends_on_the_order_of_windows(tmp_path):
    model = untrained("RNIN")
    save_model(tmp_path / "rnin.safetensors", model.training_form, model.card)
    loaded = load_model(tmp_path / "rnin.safetensors")
    windows = random_windows(6)
    at_once = loaded.predict_next(windows, 3)[0]
    memory, one_by_one = None, []
    for k in range(6):
        moved, _, memory = loaded.predict_next(windows[k : k + 1], 3, memory)
        one_by_one.append(moved[0])
    np.testing.assert_allclose(at_once, one_by_one, atol=1e-6)
    # The first window of each series has no predecessor, the others do.
    alone = loaded.predict(windows)[0]
    np.testing.assert_allclose(at_once[:3], alone[:3], atol=1e-5)
    assert (np.abs(at_once[3:] - alone[3:]).max(axis=1) > 1e-5).all()
