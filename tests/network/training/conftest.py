import pytest
from training_runs import narrow, run

from stario.network.card import card_path


@pytest.fixture(scope="module", autouse=True)
def _narrow():
    with pytest.MonkeyPatch.context() as patch:
        narrow(patch)
        yield


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A run without interruption: the model's path and the reports of its epochs."""
    reports = []
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        narrow(patch)
        return run(folder, on_epoch=reports.append, words=["swings"]), reports


@pytest.fixture
def model(finished, tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(finished[0].read_bytes())
    card_path(path).write_bytes(card_path(finished[0]).read_bytes())
    return path
