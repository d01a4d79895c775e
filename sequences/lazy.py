"""Lazy imports: public names that are imported on first use, and optional packages.

SciPy, torch and gtsam take up to seconds to import; `stario --help` and callers that need a single
reader should not wait for them.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any

from stario.sequences.errors import MissingPackageError


def lazy_attributes(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a module's `__getattr__` (PEP 562) that imports names from the given modules."""

    def attribute(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return attribute


def optional_package(name: str, extra: str) -> Any:
    """Import and return an optional package.

    Raises:
        MissingPackageError: the error names the extra that installs the package.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.split(".")[0]
        fix = f'pip install "stario[{extra}]"'
        expected = f"the package {package}"
        raise MissingPackageError(package, "not installed", expected, fix) from None
