"""What the files hold that a piece of work names: with others in their place it is other work."""

from __future__ import annotations

import hashlib
import re
from contextlib import suppress
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_NAMING = ("planner", "scene", "backend")  # fields of a spec whose texts may name files
_BETWEEN = re.compile(r"[,=\s]+")
_IN_MODULE = re.compile(r"[\w.]+:[\w.]+")


def file_hashes(spec: Any) -> dict[str, str]:
    """Hashes of the files that planner, scene and backend of a spec name, by the name.

    Options are looked through, too, as in ``policy,path=FILE``; ``module:Class`` names the source
    of the module, which may have imported what is not looked at. Folders count for nothing.
    """
    texts = [getattr(spec, name, None) for name in _NAMING]
    parts = [
        part
        for text in texts
        if isinstance(text, str)
        for part in _BETWEEN.split(text.removeprefix("command:"))
    ]
    hashes = {part: digest(path) for part in parts if (path := _file(part))}
    return {part: text for part, text in hashes.items() if text}


def digest(path: Path) -> str:
    """Of a file's bytes; empty where there is none, or it cannot be read."""
    with suppress(OSError):
        found = path.stat()
        return _digest(path.resolve(), found.st_mtime_ns, found.st_size)
    return ""


@lru_cache(maxsize=1024)
def _digest(path: Path, _mtime: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def _file(part: str) -> Path | None:
    """The file that a part of a text names, if it does."""
    with suppress(OSError, ValueError):  # a name too long, with a null byte
        if ("/" in part or "." in part) and Path(part).is_file():
            return Path(part)
    if _IN_MODULE.fullmatch(part):
        with suppress(ImportError, ValueError, AttributeError):
            found = find_spec(part.partition(":")[0])
            if found and found.has_location and found.origin:
                return Path(found.origin)
    return None
