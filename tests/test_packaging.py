"""The installed package matches the source tree."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
import tomllib
import typing
from graphlib import TopologicalSorter
from pathlib import Path

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
def test_readme_names_every_public_name_and_each_can_be_imported(package):
    module = importlib.import_module(f"stario.{package}")
    text = (ROOT / package / "README.md").read_text()
    for name in module.__all__:
        assert getattr(module, name) is not None
        assert re.search(rf"`{name}\b", text), name
    assert dir(module) == module.__all__


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


def test_sequences_import_neither_network_nor_fusion_and_network_not_fusion():
    forbidden = {"sequences": ("stario.network", "stario.fusion"), "network": ("stario.fusion",)}
    for folder, names in forbidden.items():
        for path in (ROOT / folder).rglob("*.py"):
            text = path.read_text()
            assert not any(f"from {name}" in text or f"import {name}" in text for name in names)


def _modules_imported(path: Path) -> set[str]:
    """Modules of stario that a file imports at run time, including imports inside functions."""
    tree, found = ast.parse(path.read_text()), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            node.body = []
    for node in ast.walk(tree):
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


@pytest.mark.slow
def test_wheel_installs_and_runs_outside_the_tree(tmp_path):
    def call(*command: str) -> str:
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    call(sys.executable, "-m", "build", "--outdir", str(tmp_path / "dist"), str(ROOT))
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    assert sdist.stat().st_size > 1_000_000  # it contains the weights
    call(sys.executable, "-m", "venv", "fresh")
    call("fresh/bin/pip", "install", "-q", "-c", str(ROOT / "constraints.txt"), str(wheel))
    out = call("fresh/bin/stario", "compare", "--out", "demo")
    assert "dead reckoning" in out
    assert (tmp_path / "demo/metrics.json").exists()
    assert (tmp_path / "demo/demonstration/plan.png").exists()
