"""Packages whose names are imported when they are asked for.

A command that only reads its options then waits for no ray caster.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any


def lazy_names(package: str) -> Callable[[str], Any]:
    """``__getattr__`` of a package: imports what its block ``if TYPE_CHECKING:`` imports, by name.

    That block is the one list of what the package offers, for type checkers and for Python.
    """

    @cache
    def places() -> dict[str, str]:
        spec = sys.modules[package].__spec__
        assert spec is not None
        source = spec.loader.get_source(package)  # type: ignore[union-attr]
        blocks = [node.body for node in ast.parse(source).body if isinstance(node, ast.If)]
        found = [node for node in blocks[0] if isinstance(node, ast.ImportFrom)]
        return {alias.name: str(node.module) for node in found for alias in node.names}

    def find(name: str) -> Any:
        if name.startswith("__") or name not in places():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(places()[name]), name)
        setattr(sys.modules[package], name, found)
        return found

    return find
