"""Warning of weights that are judged by what they were trained on."""

from pathlib import Path

import pytest
from recorded import DATA

from stario.network.training.splits import read_packaged_list, warn_of_learned

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs the development recordings")


@needs_data
def test_weights_judged_by_what_they_learned_are_named(caplog: pytest.LogCaptureFixture) -> None:
    held_out = [entry.path for entry in read_packaged_list("holdout", DATA)]
    warn_of_learned(["default", "first-stage", "open", "other.safetensors"], held_out, DATA)
    [record] = caplog.records
    count = len(held_out)
    assert record.getMessage().startswith(f"default: trained on {count} of the {count} recordings")
    caplog.clear()
    test = [entry.path for entry in read_packaged_list("test", DATA)]
    warn_of_learned(["default", "walks-36min"], test, DATA)
    assert not caplog.records


def test_nothing_is_said_of_a_folder_without_the_listed_recordings(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_learned(["default"], [tmp_path / "walk.csv"], tmp_path)
    assert not caplog.records
