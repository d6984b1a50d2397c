"""Disk cache of lit meshes, which take long to compute from a mesh file or for a home.

Entries are stored in ``$MS_SLAM_ENV_CACHE``, else in ``ms_slam_env`` below ``$XDG_CACHE_HOME`` or
``~/.cache``. Each is one file of plain arrays, named by a hash of its inputs (the mesh file's
content or the seed) and of the algorithm's version. The least recently used are deleted when all
exceed ``MOST_BYTES``; the folder may be deleted at any time. Unreadable entries are recomputed, and
an unwritable folder is ignored.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.output_files import new_file
from ms_slam_env.errors import InputError

VERSION = 2
"""Version of the content and of its computation; increases when either changes."""

MOST_BYTES = 2 * 1024**3
"""Size limit of all entries together."""

Arrays = dict[str, NDArray[Any]]


def folder() -> Path | None:
    """Folder of the entries; None for a user without a home folder."""
    own, base = os.environ.get("MS_SLAM_ENV_CACHE"), os.environ.get("XDG_CACHE_HOME")
    home = os.path.expanduser("~")
    if not (own or base) and home == "~":
        return None
    return Path(own) if own else Path(base or f"{home}/.cache") / "ms_slam_env"


def key(arrays: Iterable[NDArray[Any]], more: object) -> str:
    """Name of an entry: a hash of all its inputs."""
    digest = hashlib.sha256(repr((VERSION, more)).encode())
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:40]


def remembered(name: str, work_out: Callable[[], Arrays]) -> Arrays:
    """Load the arrays of entry ``name``, or compute and store them if missing or damaged."""
    place = folder()
    if place is None:
        return work_out()
    path = place / f"mesh-{name}.npz"
    # Readers may raise anything on a damaged archive; it is recomputed.
    with suppress(Exception), np.load(path, allow_pickle=False) as stored:
        found = {array: stored[array] for array in stored["names"].tolist()}
        os.utime(path)
        return found
    arrays = work_out()
    with suppress(OSError, InputError):  # a full or unwritable disk
        _keep(path, arrays)
    return arrays


def _keep(path: Path, arrays: Arrays) -> None:
    """Write an entry atomically, and make room for it."""
    named: dict[str, Any] = {"names": np.array(list(arrays)), **arrays}
    with new_file(path) as descriptor, os.fdopen(descriptor, "wb", closefd=False) as file:
        np.savez(file, **named)
    _make_room(path.parent)


def _make_room(place: Path) -> None:
    """Delete the least recently used entries until all fit."""
    entries = sorted(place.glob("mesh-*.npz"), key=lambda one: one.stat().st_mtime, reverse=True)
    total = 0
    for one in entries:
        total += one.stat().st_size
        if total > MOST_BYTES:
            one.unlink(missing_ok=True)
