"""Lit meshes kept on disk: what a mesh file or a dwelling becomes takes long to work out.

Entries lie in ``$MS_SLAM_ENV_CACHE``, else in ``ms_slam_env`` below ``$XDG_CACHE_HOME`` or
``~/.cache``: one file of plain arrays each, named by a hash of what it follows from, what the mesh
file holds or the seed, and of the version of the algorithm. The longest unused go when all take
more than ``MOST_BYTES``; the folder may be deleted at any time. What cannot be read is worked out
anew, and a folder that cannot be written is done without.
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
"""Of what is kept and how it is worked out; goes up when either changes."""

MOST_BYTES = 2 * 1024**3
"""Of all entries together."""

Arrays = dict[str, NDArray[Any]]


def folder() -> Path | None:
    """Where the entries lie; None for a user without a home folder."""
    own, base = os.environ.get("MS_SLAM_ENV_CACHE"), os.environ.get("XDG_CACHE_HOME")
    home = os.path.expanduser("~")
    if not (own or base) and home == "~":
        return None
    return Path(own) if own else Path(base or f"{home}/.cache") / "ms_slam_env"


def key(arrays: Iterable[NDArray[Any]], more: object) -> str:
    """Name of an entry: a hash of everything that it follows from."""
    digest = hashlib.sha256(repr((VERSION, more)).encode())
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:40]


def remembered(name: str, work_out: Callable[[], Arrays]) -> Arrays:
    """The arrays of entry ``name``; worked out, and kept, where it is not there or broken."""
    place = folder()
    if place is None:
        return work_out()
    path = place / f"mesh-{name}.npz"
    # Whatever a damaged archive makes its readers raise: it is made anew.
    with suppress(Exception), np.load(path, allow_pickle=False) as stored:
        found = {array: stored[array] for array in stored["names"].tolist()}
        os.utime(path)
        return found
    arrays = work_out()
    with suppress(OSError, InputError):  # a disk, a place that takes no file
        _keep(path, arrays)
    return arrays


def _keep(path: Path, arrays: Arrays) -> None:
    """Write an entry, whole or not at all, and make room for it."""
    named: dict[str, Any] = {"names": np.array(list(arrays)), **arrays}
    with new_file(path) as descriptor, os.fdopen(descriptor, "wb", closefd=False) as file:
        np.savez(file, **named)
    _make_room(path.parent)


def _make_room(place: Path) -> None:
    """Delete the longest unused entries until all fit."""
    entries = sorted(place.glob("mesh-*.npz"), key=lambda one: one.stat().st_mtime, reverse=True)
    total = 0
    for one in entries:
        total += one.stat().st_size
        if total > MOST_BYTES:
            one.unlink(missing_ok=True)
