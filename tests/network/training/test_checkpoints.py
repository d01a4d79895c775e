import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
from training_runs import HELD_OUT, STREAMS, TINY, run, swaying

from stario.network.model import load_model
from stario.network.training.checkpoint import exclusive
from stario.network.training.data import TrainingData
from stario.network.training.train import train
from stario.sequences.errors import ConfigError, InputError, ReadError


def test_a_killed_and_resumed_run_gives_the_same_weights(finished, tmp_path):
    def kill(step, loss):
        if step == 21:  # in the third epoch of eight steps
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, on_step=kill)
    assert not (tmp_path / "model.safetensors").exists()
    reports = []
    resumed = safetensors.torch.load_file(run(tmp_path, on_epoch=reports.append))
    expected = safetensors.torch.load_file(finished[0])
    assert [r.epoch for r in reports] == [3, 4]
    assert resumed.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(resumed[name], value), name


def test_a_finished_run_is_not_trained_further(finished, tmp_path, caplog):
    checkpoint = tmp_path / "checkpoint.safetensors"
    checkpoint.write_bytes((finished[0].parent / checkpoint.name).read_bytes())
    steps = []
    path = run(tmp_path, on_step=lambda step, loss: steps.append(step), words=["swings"])
    assert steps == []
    assert path.read_bytes() == finished[0].read_bytes()
    assert "all 4 epochs are done" in caplog.text
    lost = "log.json"  # written again
    assert (tmp_path / lost).read_text() == (finished[0].parent / lost).read_text()


def test_a_checkpoint_of_other_recordings_or_another_recipe_is_refused(finished):
    """Also of those that were corrected since: names and lengths are the same, numbers are not."""
    folder, first = finished[0].parent, STREAMS[0]
    swapped = replace(first, position_W=first.position_W[:, [1, 0, 2]])
    scaled = replace(first, position_W=1.01 * first.position_W)
    other_sign = replace(first, imu_W=first.imu_W * np.float32([1, 1, 1, -1, 1, 1]))
    for others in (
        TrainingData([*STREAMS, swaying("e", 0.1)]),
        TrainingData(STREAMS, [1.0, 2.0]),
        *(TrainingData([corrected, STREAMS[1]]) for corrected in (swapped, scaled, other_sign)),
    ):
        with pytest.raises(ConfigError, match="other recordings"):
            train(TINY, others, HELD_OUT, folder)
    with pytest.raises(ConfigError, match="initial weights"):
        run(folder, start_from=load_model(finished[0]))
    harder = replace(TINY, augmentation=replace(TINY.augmentation, tilt=0.3))
    for recipe, words in ((replace(TINY, rate=0.01), r"rate: .*0\.001"), (harder, "augmentation")):
        with pytest.raises(ConfigError, match=words):
            run(finished[0].parent, recipe)


@pytest.mark.parametrize("length", [0, 1000])
def test_a_truncated_checkpoint_is_named(finished, tmp_path, length):
    whole = (finished[0].parent / "checkpoint.safetensors").read_bytes()
    (tmp_path / "checkpoint.safetensors").write_bytes(whole[:length])
    with pytest.raises(ReadError, match=r"checkpoint.safetensors: checkpoint: found .*complete"):
        run(tmp_path)


@pytest.mark.parametrize(
    ("metadata", "without"),
    [
        ({"step": "x"}, "none"),
        ({"history": "["}, "none"),
        ({"history": "[5]"}, "none"),
        ({"config": "5"}, "none"),
        ({}, "network."),
        ({}, "random."),
    ],
)
def test_a_damaged_checkpoint_is_named_with_the_remedy(finished, tmp_path, metadata, without):
    path = tmp_path / "checkpoint.safetensors"
    with safetensors.safe_open(finished[0].parent / path.name, framework="pt") as whole:
        tensors = {key: whole.get_tensor(key) for key in whole.keys()}  # noqa: SIM118
        kept = {key: value for key, value in tensors.items() if not key.startswith(without)}
        path.write_bytes(safetensors.torch.save(kept, {**whole.metadata(), **metadata}))
    with pytest.raises(ReadError, match=r"checkpoint: .*remove it") as error:
        run(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
def test_a_folder_is_refused_while_another_run_trains_there(tmp_path):
    """The system frees the folder of a run that is killed."""
    with exclusive(tmp_path):
        with pytest.raises(ConfigError, match="another run is training") as caught:
            run(tmp_path)
        assert str(tmp_path) in str(caught.value)
        assert not list(tmp_path.glob("*.safetensors"))
    with exclusive(tmp_path):
        pass


def test_only_old_temporary_files_are_removed_and_a_bad_folder_is_named(tmp_path):
    young, old = (tmp_path / f".checkpoint.safetensors.{name}.tmp" for name in ("young", "old"))
    for path in (young, old):
        path.touch()
    os.utime(old, (0.0, 0.0))
    with exclusive(tmp_path):
        assert young.exists()
        assert not old.exists()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/run.*--out"), exclusive(tmp_path / "file/run"):
        pass
