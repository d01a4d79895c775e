"""Files of weights, and the network that they hold."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

import stario.network
from stario.network.card import MAX_SIGMA, Calibration, card_path
from stario.network.model import load_model, weights_named
from stario.network.stario import moments, rms_normalised
from stario.sequences.errors import InputError, StarioError, WeightsError

DEFAULT = Path(stario.network.__file__).with_name("weights") / "default.safetensors"


@pytest.fixture
def model(tmp_path):
    """A copy of the default weights and their card, to be corrupted."""
    path = tmp_path / "model.safetensors"
    path.write_bytes(DEFAULT.read_bytes())
    card_path(path).write_bytes(card_path(DEFAULT).read_bytes())
    return path


def change_card(path: Path, **values: object) -> None:
    content = json.loads(card_path(path).read_text(encoding="utf-8"))
    card_path(path).write_text(json.dumps(content | values), encoding="utf-8")


def refusal(path: Path) -> str:
    with pytest.raises(WeightsError) as caught:
        load_model(path)
    assert isinstance(caught.value, StarioError)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path.parent) in text
    return text


def test_a_model_prints_its_architecture_and_checksum():
    model = load_model("default")
    assert repr(model) == f"DisplacementModel(StarIO, sha256 {model.card.sha256[:12]})"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("architecture", "ResNet99"),
        ("architecture", ["StarIO"]),
        ("sha256", "0" * 64),
        ("sha256", 7),
        ("outputs", 2),
        ("rate", 100.0),
        ("samples", 400),
        ("frame", "body"),
        ("channels", ["accel_x"]),
        ("format", 2),
        ("colour", "red"),
        ("calibration", {"scale": [1.0, 1.0], "floor": [0.0, 0.0, 0.0]}),
        ("calibration", {"scale": [1.0, 1.0, -1.0], "floor": [0.0, 0.0, 0.0]}),
        ("calibration", {"tint": [1.0, 1.0, 1.0]}),
        ("calibration", 1.0),
    ],
)
def test_a_card_that_does_not_match_is_refused(model, field, value):
    change_card(model, **{field: value})
    assert field in refusal(model)


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [("floor", 0.0, "a covariance of 0"), ("exponent", 1e300, "up to 10")],
)
def test_a_calibration_that_gives_no_valid_covariance_is_refused(model, part, value, words):
    calibration = json.loads(card_path(DEFAULT).read_text(encoding="utf-8"))["calibration"]
    change_card(model, calibration=calibration | {part: [0.5, 0.5, value]})
    assert words in refusal(model)


def test_sigma_lies_between_its_floor_and_the_longest_way_of_a_second():
    calibration = Calibration((2.0, 2.0, 1.0), (1.5, 1.5, 1.0), (0.02, 0.02, 0.03))
    certain, usual, lost = calibration.variance(np.log([[1e-9] * 3, [0.25] * 3, [1e3] * 3]))
    np.testing.assert_allclose(certain, np.square([0.02, 0.02, 0.03]), rtol=1e-6)
    scaled = np.square([2.0 * 0.25**1.5, 2.0 * 0.25**1.5, 0.25])
    np.testing.assert_allclose(usual, scaled + certain)
    np.testing.assert_allclose(lost, MAX_SIGMA**2 + certain)


@pytest.mark.parametrize("field", ["format", "outputs", "rate", "samples", "frame", "channels"])
def test_a_card_that_lacks_a_field_is_refused(model, field):
    content = json.loads(card_path(model).read_text(encoding="utf-8"))
    del content[field]
    card_path(model).write_text(json.dumps(content), encoding="utf-8")
    assert f"no {field!r}" in refusal(model)


def test_an_intact_copy_loads(model):
    assert load_model(model).name == "StarIO"
    assert load_model(str(model)).name == "StarIO"


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"architecture": "StarIO"}', "\udcff"])
def test_a_file_that_is_no_card_is_refused(model, text):
    card_path(model).write_bytes(text.encode(errors="surrogateescape"))
    assert "card" in refusal(model)


def test_truncated_weights_are_refused(model):
    model.write_bytes(model.read_bytes()[:-100])
    assert "truncated" in refusal(model)


@pytest.mark.parametrize("missing", ["weights", "card"])
def test_weights_or_a_card_alone_are_refused(model, missing):
    (model if missing == "weights" else card_path(model)).unlink()
    assert "in one folder" in refusal(model)


def write_weights(path: Path, state: dict[str, torch.Tensor]) -> None:
    """Write other tensors, with a card of the right checksum."""
    content = safetensors.torch.save(state)
    path.write_bytes(content)
    change_card(path, sha256=hashlib.sha256(content).hexdigest())


@pytest.mark.parametrize("change", ["unknown", "missing", "shape", "none"])
def test_tensors_of_another_network_are_refused(model, change):
    state = safetensors.torch.load_file(model)
    if change == "unknown":
        state["another.weight"] = torch.zeros(3)
    elif change == "missing":
        del state["head.7.bias"]
    elif change == "shape":
        state["head.7.bias"] = torch.zeros(2)
    write_weights(model, state if change != "none" else {})
    found = {"unknown": "another.weight", "missing": "head.7.bias", "shape": "head.7.bias"}
    assert found.get(change, "Missing") in refusal(model)


def test_the_folder_of_a_run_is_refused_with_the_file_in_it(model):
    with pytest.raises(WeightsError, match=r"a folder, .*model\.safetensors"):
        load_model(model.parent)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_windows_with_a_value_that_is_not_finite_are_refused(value):
    windows = np.zeros((2, 6, 200))
    windows[1, 4, 7] = value
    with pytest.raises(InputError, match="not finite"):
        load_model().predict(windows)


@pytest.mark.parametrize("windows", ["walk.csv", [[1.0], [1.0, 2.0]], np.zeros((6, 200))])
def test_windows_that_are_none_are_refused(windows):
    with pytest.raises(InputError, match=r"windows: .*\(B, 6, 200\)"):
        load_model().predict(windows)


def test_gradient_of_the_deviation_of_a_constant_is_finite():
    x = torch.full((2, 3, 5), 7.0, requires_grad=True)
    moments(x, dim=2)[1].sum().backward()
    assert torch.isfinite(x.grad).all()


def test_moments_are_mean_and_deviation():
    x = torch.randn(4, 8, 50, generator=torch.Generator().manual_seed(0)) * 3.0 + 1.0
    mean, deviation = moments(x, dim=2)
    torch.testing.assert_close(mean, x.mean(2, keepdim=True))
    expected = x.std(2, correction=0, keepdim=True)
    torch.testing.assert_close(deviation, expected, rtol=1e-4, atol=0.0)


def test_normalised_windows_have_unit_mean_square_at_any_scale():
    x = torch.randn(3, 8, 50) * torch.tensor([0.1, 1.0, 1e4]).view(3, 1, 1)
    square = rms_normalised(x).square().mean(dim=(1, 2))
    torch.testing.assert_close(square, torch.ones(3), rtol=2e-3, atol=0.0)


def test_weights_are_found_by_network_name_in_the_runs_folder(tmp_path):
    assert weights_named("StarIO", tmp_path) == "default"
    assert weights_named("some/file.onnx", tmp_path) == "some/file.onnx"
    with pytest.raises(WeightsError, match=r"stario train --model 'RNIN'"):
        weights_named("RNIN", tmp_path)
    (tmp_path / "RNIN").mkdir()
    (tmp_path / "RNIN" / "model.safetensors").touch()
    assert weights_named("RNIN", tmp_path) == tmp_path / "RNIN" / "model.safetensors"
