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
    path = tmp_path / "model.safetensors"
    path.write_bytes(DEFAULT.read_bytes())
    card_path(path).write_bytes(card_path(DEFAULT).read_bytes())
    return path


def change_card(path: Path, **values: object) -> None:
    """Change fields of a card, or remove those that are None."""
    content = json.loads(card_path(path).read_text(encoding="utf-8")) | values
    kept = {name: value for name, value in content.items() if value is not None}
    card_path(path).write_text(json.dumps(kept), encoding="utf-8")


def refusal(path: Path) -> str:
    with pytest.raises(WeightsError) as caught:
        load_model(path)
    assert isinstance(caught.value, StarioError)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path.parent) in text
    return text


def test_sigma_lies_between_its_floor_and_the_longest_way_of_a_second():
    calibration = Calibration((2.0, 2.0, 1.0), (1.5, 1.5, 1.0), (0.02, 0.02, 0.03))
    certain, usual, lost = calibration.variance(np.log([[1e-9] * 3, [0.25] * 3, [1e3] * 3]))
    np.testing.assert_allclose(certain, np.square([0.02, 0.02, 0.03]), rtol=1e-6)
    scaled = np.square([2.0 * 0.25**1.5, 2.0 * 0.25**1.5, 0.25])
    np.testing.assert_allclose(usual, scaled + certain)
    np.testing.assert_allclose(lost, MAX_SIGMA**2 + certain)


CALIBRATION = {"scale": [1.0] * 3, "exponent": [0.5] * 3, "floor": [0.1] * 3}


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("architecture", "ResNet99", "architecture"),
        ("architecture", ["StarIO"], "architecture"),
        ("sha256", "0" * 64, "sha256"),
        ("sha256", 7, "sha256"),
        ("outputs", 2, "outputs"),
        ("rate", 100.0, "rate"),
        ("samples", 400, "samples"),
        ("frame", "body", "frame"),
        ("channels", ["accel_x"], "channels"),
        ("format", 2, "format"),
        ("colour", "red", "colour"),
        *[(field, None, f"no '{field}'") for field in ("format", "outputs", "rate")],
        *[(field, None, f"no '{field}'") for field in ("samples", "frame", "channels")],
        ("calibration", {"scale": [1.0, 1.0], "floor": [0.0, 0.0, 0.0]}, "calibration"),
        ("calibration", {"scale": [1.0, 1.0, -1.0], "floor": [0.0, 0.0, 0.0]}, "calibration"),
        ("calibration", {"tint": [1.0, 1.0, 1.0]}, "calibration"),
        ("calibration", 1.0, "calibration"),
        ("calibration", CALIBRATION | {"floor": [0.5, 0.5, 0.0]}, "a covariance of 0"),
        ("calibration", CALIBRATION | {"exponent": [0.5, 0.5, 1e300]}, "up to 10"),
    ],
)
def test_a_card_that_does_not_match_is_refused(model, field, value, words):
    change_card(model, **{field: value})
    assert words in refusal(model)


def change_tensors(path: Path, **values: torch.Tensor | None) -> None:
    """Replace tensors, add or remove some, or all; the card has the right checksum."""
    state = safetensors.torch.load_file(path) | values if values else {}
    content = safetensors.torch.save({k: v for k, v in state.items() if v is not None})
    path.write_bytes(content)
    change_card(path, sha256=hashlib.sha256(content).hexdigest())


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        *[
            (lambda path, text=text: card_path(path).write_bytes(text), "card")
            for text in (b"", b"{", b"[]", b"3", b'{"architecture": "StarIO"}', b"\xff")
        ],
        (lambda path: path.write_bytes(path.read_bytes()[:-100]), "truncated"),
        (lambda path: path.unlink(), "in one folder"),
        (lambda path: card_path(path).unlink(), "in one folder"),
        (lambda path: change_tensors(path, another=torch.zeros(3)), "another"),
        (lambda path: change_tensors(path, **{"head.7.bias": torch.zeros(2)}), "head.7.bias"),
        (lambda path: change_tensors(path, **{"head.7.bias": None}), "head.7.bias"),
        (change_tensors, "Missing"),
    ],
)
def test_a_damaged_file_is_refused(model, damage, words):
    damage(model)
    assert words in refusal(model)


def test_an_intact_copy_loads_prints_what_it_is_and_its_folder_is_refused(model):
    assert load_model(model).name == "StarIO"
    assert load_model(str(model)).name == "StarIO"
    loaded = load_model("default")
    assert repr(loaded) == f"DisplacementModel(StarIO, sha256 {loaded.card.sha256[:12]})"
    with pytest.raises(WeightsError, match=r"a folder, .*model\.safetensors"):
        load_model(model.parent)


@pytest.mark.parametrize(
    ("windows", "words"),
    [
        ("walk.csv", r"\(B, 6, 200\)"),
        ([[1.0], [1.0, 2.0]], r"\(B, 6, 200\)"),
        (np.zeros((6, 200)), r"\(B, 6, 200\)"),
        (np.full((2, 6, 200), np.nan), "not finite"),
        (np.full((2, 6, 200), np.inf), "not finite"),
    ],
)
def test_windows_that_are_none_are_refused(windows, words):
    with pytest.raises(InputError, match=f"windows: .*{words}"):
        load_model().predict(windows)


def test_moments_are_mean_and_deviation_with_finite_gradients_and_normalise():
    x = torch.randn(4, 8, 50, generator=torch.Generator().manual_seed(0)) * 3.0 + 1.0
    mean, deviation = moments(x, dim=2)
    torch.testing.assert_close(mean, x.mean(2, keepdim=True))
    expected = x.std(2, correction=0, keepdim=True)
    torch.testing.assert_close(deviation, expected, rtol=1e-4, atol=0.0)
    x = torch.full((2, 3, 5), 7.0, requires_grad=True)
    moments(x, dim=2)[1].sum().backward()
    assert torch.isfinite(x.grad).all()
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
