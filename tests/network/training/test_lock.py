"""Two runs in one folder, and what killed runs leave in it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from training_runs import run

from stario.network.training.lock import exclusive
from stario.sequences.errors import ConfigError, InputError

HOLDING = """
import sys, time
from pathlib import Path
from stario.network.training.lock import exclusive
with exclusive(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60.0)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
def test_a_folder_is_refused_while_another_run_trains_there_and_free_once_it_is_killed(
    tmp_path: Path,
) -> None:
    command = [sys.executable, "-c", HOLDING, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "locked\n"
        with pytest.raises(ConfigError, match="another run is training") as caught:
            run(tmp_path)
        assert str(tmp_path) in str(caught.value)
        assert not list(tmp_path.glob("*.safetensors"))
        other.kill()
    with exclusive(tmp_path):
        pass


def test_only_old_temporary_files_are_removed(tmp_path: Path) -> None:
    young, old = (tmp_path / f".checkpoint.safetensors.{name}.tmp" for name in ("young", "old"))
    for path in (young, old):
        path.touch()
    os.utime(old, (0.0, 0.0))
    with exclusive(tmp_path):
        assert young.exists()
        assert not old.exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/run.*--out"), exclusive(tmp_path / "file/run"):
        pass
