from copy import deepcopy

import pytest
from simulated import Oracle, Still, cut_once, simulated_walk, without


@pytest.fixture(scope="session", autouse=True)
def _cut_once():
    """Cut each recording once per settings: for the oracle and for the tracks of every back end.

    The front end is copied, since its counts are changed later.
    """

    def copied(sequence, config):
        intervals, front_end = cut_once(sequence, config)
        return list(intervals), deepcopy(front_end)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stario.fusion.recording.cut_recording", copied)
        yield


@pytest.fixture(scope="session")
def make_walk():
    return simulated_walk


@pytest.fixture(scope="session")
def make_oracle():
    return Oracle


@pytest.fixture(scope="session")
def still_model():
    return Still()


@pytest.fixture(scope="session")
def walk():
    """Twenty seconds hand-held at 100 Hz, by an IMU with noise and biases."""
    return simulated_walk()


@pytest.fixture(scope="session", name="without")
def _without():
    return without


@pytest.fixture
def narrow_network(monkeypatch):
    from training_runs import narrow  # which imports torch, for seconds

    narrow(monkeypatch)


@pytest.fixture
def blank_figures(monkeypatch):
    """Draw figures, but leave their files empty: rendering takes most of the time."""
    saved = "stario.fusion.evaluation.results.save_figure"
    monkeypatch.setattr(saved, lambda figure, path: path.touch())
