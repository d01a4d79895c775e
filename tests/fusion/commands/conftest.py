import sys
from dataclasses import dataclass
from functools import cache

import pytest
import typer
from typer.testing import CliRunner

from stario.fusion.commands.cli import app, main
from stario.network.model import load_model


@dataclass(frozen=True)
class CommandResult:
    code: int
    out: str
    err: str

    def assert_one_line_error(self, *words: str) -> None:
        assert self.code == 1
        assert self.out == ""
        lines = self.err.strip().splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("stario: ")
        for word in words:
            assert word in lines[0]


@pytest.fixture(scope="session", autouse=True)
def _prepared_once():
    """Load the packaged weights and build the command once, not at every call."""

    default = cache(load_model)

    def loaded(name_or_path="default"):
        return default() if name_or_path == "default" else load_model(name_or_path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stario.network.model.load_model", loaded)
        patch.setattr("typer.main.get_command", cache(typer.main.get_command))
        yield


@pytest.fixture
def stario(monkeypatch, tmp_path, tmp_path_factory, capsys):
    """Call `stario` with arguments, in this process and in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STARIO_CACHE", str(tmp_path_factory.mktemp("cache")))

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["stario", *map(str, arguments)])
        capsys.readouterr()
        code = 0
        try:
            main()
        except SystemExit as leaving:
            code = int(leaving.code or 0)
        captured = capsys.readouterr()
        return CommandResult(code, captured.out, captured.err)

    return call


@pytest.fixture
def no_figures(monkeypatch):
    """Skip figures, in tests that do not check them."""
    monkeypatch.setattr("stario.fusion.evaluation.results._figures", lambda found: {})
    saved = "stario.sequences.drawing.figures.save_figure"  # of `inspect`
    monkeypatch.setattr(saved, lambda figure, path: path.touch())


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A walk of twelve seconds on the level, which no test modifies."""
    path = tmp_path_factory.mktemp("recordings") / "walk.csv"
    walk = ["--seconds", "12", "--carry", "handheld", "--rate", "100", "--seed", "5"]
    result = CliRunner().invoke(app, ["simulate", str(path), *walk])
    assert result.exit_code == 0, result.output
    return path
