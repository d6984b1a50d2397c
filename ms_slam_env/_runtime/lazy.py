"""Lazy imports: packages whose names are imported on first use.

A command that only reads its options then does not wait for the ray caster.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any


def lazy_names(package: str) -> Callable[[str], Any]:
    """A ``__getattr__`` for a package that imports the names of its ``if TYPE_CHECKING:`` block.

    That block is then the single list of public names, for type checkers and for Python.
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
