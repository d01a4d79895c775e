import ast
import importlib
import inspect
import re
import shutil
import subprocess
import sys
import tomllib
import typing
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("fusion", "network", "sequences")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_in_the_tree_is_listed_in_pyproject():
    found = {
        "stario." + ".".join(p.parent.relative_to(ROOT).parts)
        for folder in FOLDERS
        for p in (ROOT / folder).rglob("__init__.py")
    }
    assert found == set(PROJECT["tool"]["setuptools"]["packages"])


@pytest.mark.parametrize("package", FOLDERS)
def test_a_package_lists_its_public_names_by_task_and_each_can_be_imported(package):
    module = importlib.import_module(f"stario.{package}")
    assert sorted(re.findall(r"`(\w+)`", module.__doc__)) == module.__all__ == dir(module)
    for name in module.__all__:
        assert getattr(module, name) is not None


def test_what_public_functions_return_is_public_too():
    public = {
        getattr(module, name)
        for module in map(importlib.import_module, (f"stario.{folder}" for folder in FOLDERS))
        for name in module.__all__
        if callable(getattr(module, name))
    }
    for function in filter(inspect.isfunction, public):
        returned = typing.get_type_hints(function)["return"]
        for kind in (returned, *typing.get_args(returned)):
            if getattr(kind, "__module__", "").startswith("stario."):
                assert kind in public, f"{function.__name__} returns {kind}"


def test_examples_import_only_from_public_packages():
    for path in (ROOT / "examples").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stario"):
                assert node.module.count(".") == 1, f"{path.name}: {node.module}"


def test_every_folder_with_modules_is_a_package():
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*.py"):
            assert (path.parent / "__init__.py").exists(), path


def test_constraints_pin_every_dependency():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert pinned["torch"] == "2.13.0"
    for requirement in PROJECT["project"]["dependencies"]:
        assert requirement.split(">=")[0] in pinned


def test_no_package_imports_one_that_builds_on_it():
    forbidden = {
        "sequences": ("stario.network", "stario.fusion"),
        "network": ("stario.fusion",),
        "fusion/live": ("stario.fusion.evaluation",),  # nor its pandas: a server starts at once
    }
    for folder, names in forbidden.items():
        for path in (ROOT / folder).rglob("*.py"):
            text = path.read_text()
            assert not any(f"from {name}" in text or f"import {name}" in text for name in names)


def _statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements that run, including those inside functions; expressions are not walked."""
    for node in body:
        yield node
        typing_only = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for part in ("body", "handlers", "orelse", "finalbody")[typing_only:]:
            yield from _statements(getattr(node, part, []))


def _modules_imported(path: Path) -> set[str]:
    """Modules of stario that a file imports at run time, including imports inside functions."""
    found = set()
    for node in _statements(ast.parse(path.read_text()).body):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stario."):
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
    return found


def test_modules_have_no_circular_imports():
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    names = {
        ".".join(("stario", *path.relative_to(ROOT).with_suffix("").parts)): path for path in files
    }
    graph = {name: _modules_imported(path) & names.keys() for name, path in names.items()}
    TopologicalSorter(graph).prepare()


def test_help_imports_nothing_heavy():
    code = (
        "import sys, stario.fusion.commands.cli\n"
        "heavy = {'torch', 'gtsam', 'matplotlib', 'scipy', 'numpy'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_another_package_of_this_name_is_refused_by_name(tmp_path):
    (tmp_path / "stario").mkdir()
    (tmp_path / "stario/__init__.py").touch()
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import stario.network"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    *_, error = done.stderr.splitlines()
    assert error.startswith("ImportError: stario: found another package")
    assert str(tmp_path / "stario") in error
    assert "pip uninstall stario" in error


def called(folder: Path, *command: str | Path) -> str:
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """A folder outside the tree, with the built distributions and an environment of the wheel."""
    folder = tmp_path_factory.mktemp("outside")
    # A copy, since building writes into the tree: two workers would do so at once.
    skipped = shutil.ignore_patterns(
        ".git", ".venv*", "*.egg-info", "build", "__pycache__", ".*_cache"
    )
    shutil.copytree(ROOT, folder / "source", ignore=skipped)
    called(folder, sys.executable, "-m", "build", "--outdir", folder / "dist", folder / "source")
    called(folder, sys.executable, "-m", "venv", "fresh")
    [wheel] = (folder / "dist").glob("*.whl")
    called(folder, "fresh/bin/pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel)
    return folder


@pytest.mark.slow
def test_the_wheel_holds_the_weights_in_use_and_no_others(outside):
    [wheel] = (outside / "dist").glob("stario_nav-*.whl")
    [source] = (outside / "dist").glob("stario_nav-*.tar.gz")
    assert wheel.stat().st_size < 26e6
    assert source.stat().st_size < 26e6
    weights = {name for name in ZipFile(wheel).namelist() if name.endswith(".safetensors")}
    assert {Path(name).stem for name in weights} == {"default", "open"}
    done = subprocess.run(
        ["fresh/bin/stario", "compare", "--model", "first-stage"],
        capture_output=True, text=True, cwd=outside,
    )  # fmt: skip
    assert "default or open; others are files in network/weights" in done.stderr


@pytest.mark.slow
def test_the_wheel_runs_outside_the_tree(outside):
    assert "dead reckoning" in called(outside, "fresh/bin/stario", "compare", "--out", "demo")
    assert (outside / "demo/metrics.json").exists()
    assert (outside / "demo/demonstration/plan.png").exists()


_PROGRAM = """
import numpy as np
from stario.fusion import Navigator, NavState, Track
from stario.network import load_model
from stario.sequences import read_recording, write_tum

navigator = Navigator(load_model("default"))
track: Track = navigator.run(read_recording("walk.csv"))
write_tum("walk.tum", track.trajectory)
state: NavState | None = navigator.push(0.0, (0.0, 0.0, 0.0), np.zeros(3))
if state is not None:
    print(state.p_W + track.trajectory.position_W[-1], state.position_covariance)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "checker",
    [("mypy", "--strict", "--python-executable"), ("pyright", "--pythonpath")],
    ids=lambda checker: checker[0],
)
def test_type_checkers_know_the_wheel(outside, checker):
    if checker[0] == "pyright" and shutil.which("node") is None:
        pytest.skip("pyright needs node")
    pytest.importorskip(checker[0], reason=f"pip install {checker[0]}")
    program = outside / "program.py"
    command = (sys.executable, "-m", *checker, outside / "fresh/bin/python", program)
    program.write_text(_PROGRAM)
    called(outside, *command)
    program.write_text(_PROGRAM + "navigator.push('now', 1.0, 2.0)\n")
    assert subprocess.run(command, capture_output=True, cwd=outside).returncode == 1
