"""Lazy imports: public names that are imported on first use.

SciPy, torch and gtsam take up to seconds to import; `stario --help` and callers that need a single
reader should not wait for them.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazy_imports(package: str) -> tuple[list[str], Callable[[str], Any]]:
    """Return the `__all__` and the `__getattr__` (PEP 562) of the package that calls this.

    The names are those that its `__init__.py` imports below `if TYPE_CHECKING:`.
    """
    this: Any = sys.modules[package]
    tree = ast.parse(this.__spec__.loader.get_source(package))
    modules = {
        alias.name: line.module
        for block in tree.body
        if isinstance(block, ast.If)
        for line in block.body
        if isinstance(line, ast.ImportFrom) and line.module
        for alias in line.names
    }

    def attribute(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(modules[name]), name)
        setattr(this, name, value)
        return value

    return sorted(modules), attribute
