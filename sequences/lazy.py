"""Lazy imports: public names that are imported on first use, and optional packages.

SciPy, torch and gtsam take up to seconds to import; `stario --help` and callers that need a single
reader should not wait for them.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from stario.sequences.errors import MissingPackageError


def public_names(package: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's `__all__`, `__getattr__`, which imports on first use, and `__dir__`.

    The names are those that the package's stub, `__init__.pyi`, imports for type checkers. Without
    `__dir__`, completion in a shell would show none of them before its first use (PEP 562).
    """
    _refuse_other_package(sys.modules["stario"])
    module = sys.modules[package]
    stub = Path(str(module.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = (line for line in ast.parse(stub).body if isinstance(line, ast.ImportFrom))
    sources = {alias.name: str(line.module) for line in imports for alias in line.names}

    def attribute(name: str) -> Any:
        if name not in sources:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(sources[name]), name)
        setattr(module, name, value)
        return value

    names = sorted(sources)
    return names, attribute, lambda: names


def optional_package(name: str, extra: str) -> Any:
    """Import and return an optional package.

    Raises:
        MissingPackageError: the error names the extra that installs the package.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.split(".")[0]
        expected, fix = f"the package {package}", f"pip install {_requirements(extra)}"
        raise MissingPackageError(package, "not installed", expected, fix) from None


def _requirements(extra: str) -> str:
    """Return an extra's requirements for a shell, which need no index to know StarIO."""
    from importlib.metadata import requires

    named = (line.partition(";") for line in requires("stario-nav") or [])
    return " ".join(f"'{name.strip()}'" for name, _, extras in named if f'"{extra}"' in extras)


def _refuse_other_package(found: ModuleType) -> None:
    """Refuse a `stario` that is a package of its own: ours is a namespace without a file.

    On the package index that name is a web framework's, whose modules would stand in for ours.
    """
    if file := getattr(found, "__file__", None):
        raise ImportError(
            f"stario: found another package of this name ({file}), expected StarIO "
            "(stario-nav) alone; pip uninstall stario, or use an environment without it"
        )
