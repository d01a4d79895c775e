import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch
import training_runs

from stario.network.training.parallel import is_leader, workers
from stario.sequences.errors import ConfigError

SCRIPT = """
import copy, sys
from pathlib import Path
import torch
from stario.network.training.augment import Augmentation
from stario.network.training.config import TrainingConfig
from stario.network.training.data import TrainingData
from stario.network.training import train
from training_runs import swaying

if sys.argv[2] == "plain":  # no batch norm: what two processes compute is the same number
    torch.manual_seed(0)
    plain = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(1200, 6))
    train.build_network = lambda name: copy.deepcopy(plain)
config = TrainingConfig(
    architecture="TLIO", epochs=2, epoch_windows=64, batch=16, rate=1e-3, device="cpu",
    likelihood_from=0.5, average=0.5, dropout=0.0,
)
stop = int(sys.argv[3])
def kill(step, loss):
    if step == stop:
        raise KeyboardInterrupt
learned, held_out = (
    TrainingData([swaying(*given)]) for given in (("a", 0.3, 20.0), ("b", 0.8, 6.0))
)
train.train(config, learned, held_out, Path(sys.argv[1]), kill)
"""


TESTS = str(Path(training_runs.__file__).parent)


def launched(script: Path, folder: Path, processes: int, network: str, stop: int = 0) -> int:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node", str(processes), str(script), str(folder), network, str(stop)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": TESTS}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert stop or done.returncode == 0, done.stderr
    return done.returncode


def epoch_errors(folder: Path) -> list[float]:
    log = json.loads((folder / "log.json").read_text())
    return [r[name] for r in log for name in ("training_error", "validation_error")]


@pytest.mark.slow
@pytest.mark.parametrize(("network", "tolerance"), [("plain", 1e-4), ("TLIO", 0.25)])
def test_two_processes_train_like_one(network, tolerance, tmp_path):
    """Equal up to rounding without batch norms, which see half a batch in each process."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    one, two, again = (tmp_path / name for name in ("one", "two", "again"))
    launched(script, one, 1, network)
    launched(script, two, 2, network)
    assert epoch_errors(two) == pytest.approx(epoch_errors(one), rel=tolerance)
    # Killed in the second epoch and launched again: the same as without a kill.
    assert launched(script, again, 2, network, stop=6) != 0
    assert len(epoch_errors(again)) == 2
    launched(script, again, 2, network)
    weights = [safetensors.torch.load_file(f / "model.safetensors") for f in (two, again)]
    for name, value in weights[0].items():
        torch.testing.assert_close(weights[1][name], value, rtol=1e-4, atol=1e-6)


def test_without_a_launcher_the_only_process_is_the_leader(monkeypatch):
    """Also among the processes of a job scheduler, which sets some of its variables."""
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    for variables in ({}, {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "localhost"}):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        with workers("cpu", 7) as group:
            assert (group.rank, group.count) == (0, 1)
            assert group.is_leader
            assert is_leader()
            assert group.total(3.0) == 3.0
            batch = torch.arange(7)
            assert torch.equal(group.share([batch])[0], batch)


def test_a_batch_that_cannot_be_divided_is_refused(monkeypatch):
    launched_with = {"TORCHELASTIC_RUN_ID": "none", "RANK": "1", "WORLD_SIZE": "2"}
    for name, value in launched_with.items():
        monkeypatch.setenv(name, value)
    assert not is_leader()
    with pytest.raises(ConfigError, match="7 for 2 processes"), workers("cpu", 7):
        pass
