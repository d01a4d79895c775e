from pathlib import Path

import pytest
import torch

from stario.network.architectures import build_network
from stario.network.runtime.survey import measured, peak_bytes, survey, survey_table


def test_peak_memory_is_the_most_that_is_allocated_at_once() -> None:
    def work() -> torch.Tensor:
        a = torch.zeros(1000) + 1.0  # two at once
        b = a * 2.0
        del a
        c = torch.cat([b, b])  # b and a tensor twice as large
        del b
        return c.view(-1)[:10]  # a view allocates nothing

    assert peak_bytes(work) == 3 * 4000
    assert peak_bytes(lambda: None) == 0


def test_rows_hold_counts_times_and_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        assert times is not None
        assert sorted(times) == ["1", "64"]
        assert min(times.values()) > 0.0
        assert set(vars(row)) == {*measured(), "name"}
    table = survey_table(rows)
    assert "3.659 (3.659)" in table
    assert "threads" in table
