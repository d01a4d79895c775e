"""Parameters, operations, time and memory of the networks."""

import warnings

import pytest
import torch
from torch import nn

from stario.network.architectures import ARCHITECTURES, architecture, build_network
from stario.network.runtime.cost import Cost, cost, table_cost
from stario.network.runtime.survey import measured, peak_bytes, survey, survey_table
from stario.sequences.errors import InputError


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_counts_agree_with_the_paper(name):
    published = ARCHITECTURES[name]
    found = table_cost(name)
    # The paper does not specify StarIO's widths; without the MSGCU the closest is 0.4 % off.
    parameters = 4.2e-3 if name == "StarIO without MSGCU" else 0.0
    flops = {"StarIO without MSGCU": 1.5e-3, "StarIO": 1e-4}.get(name, 0.0)
    assert found.parameters / 1e6 == pytest.approx(published.parameters, rel=parameters, abs=5e-4)
    assert found.flops / 1e6 == pytest.approx(published.flops, rel=flops, abs=5e-4)


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_counts_agree_with_thop(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        thop = pytest.importorskip("thop", exc_type=ImportError)
        network = build_network(name, architecture(name).table_outputs)
        found = thop.profile(network, (torch.zeros(1, 6, 200),), verbose=False)
    ours = table_cost(name)
    assert found == (ours.flops, ours.parameters)


def test_a_module_that_runs_twice_counts_twice_and_its_parameters_once():
    layer = nn.Linear(200, 200, bias=False)
    twice = nn.Sequential(layer, layer)
    assert cost(twice) == Cost(200 * 200, 2 * 6 * 200 * 200)


def test_counting_does_not_change_the_network():
    network = build_network("DeepILS", 2)
    assert cost(network) == cost(network)
    assert not any(module._forward_hooks for module in network.modules())


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"architecture: found 'ResNet99', expected one of .*RNIN"):
        table_cost("ResNet99")


def test_peak_memory_is_the_most_that_is_allocated_at_once():
    def work():
        a = torch.zeros(1000) + 1.0  # two at once
        b = a * 2.0
        del a
        c = torch.cat([b, b])  # b and a tensor twice as large
        del b
        return c.view(-1)[:10]  # a view allocates nothing

    assert peak_bytes(work) == 3 * 4000
    assert peak_bytes(lambda: None) == 0
    layer, row = nn.Linear(1000, 100), torch.zeros(1, 1000)  # multiplied by a view of its weights
    assert peak_bytes(lambda: layer(row)) == 400


def test_rows_hold_counts_times_and_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("stario.network.runtime.survey._RUNS", {1: 2, 64: 1})
    # Exporting is slow and tested elsewhere.
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    names = ["I-IMUNet", "StarIO"]
    rows = survey(names, tmp_path)
    assert [row.name for row in rows] == names
    assert [row.numel for row in rows] == [3_661_618, 2_761_682]
    for row in rows:
        weights = 4 * sum(p.numel() for p in build_network(row.name).parameters())
        # Weights with folded norms, and little more for a single window.
        assert 0.97 * weights < 1e6 * row.peak_memory_mb < 1.3 * weights
        assert row.milliseconds["onnxruntime"] is None
        times = row.milliseconds["torch"]
        assert sorted(times) == ["1", "64"]
        assert min(times.values()) > 0.0
        assert set(vars(row)) == {*measured(), "name"}
    table = survey_table(rows)
    assert "3.659 (3.659)" in table
    assert "threads" in table
