"""Folders of results: whole or as they were before, written by one process at a time."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ms_slam_env._runtime.output_files import (
    check_kind,
    naming,
    open_own,
    process_name,
    remove_left_behind,
    working_name,
)
from ms_slam_env.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: one process at a time
    fcntl = None  # type: ignore[assignment]

_LOCK = ".ms-slam.lock"
_MOVING_S = 60.0  # that another process may take to move a result into its place
_held: set[str] = set()  # locks of this process


@contextmanager
def result_folder(out: Path, marker: str) -> Iterator[Path]:
    """A folder to write a result into, whose files then move into ``out``, ``marker`` the last.

    Who finds the marker finds the whole result. What fails or is interrupted before leaves ``out``
    as it was. The working folder lies in ``out``: on the same disk, under the same rights.

    Args:
        out: of the result; made if it is not there.
        marker: name of the file that makes the others count.

    Raises:
        InputError: a link in ``out`` leads to another place.
        OSError: with the name of the file.
    """
    with _made(out):
        remove_left_behind(out)
        working = working_name(out)
        with naming(out):
            working.mkdir()
        try:
            with _naming_target(working, out):
                yield working
                with alone_in(out, wait_s=_MOVING_S):
                    _move(working, out, marker)
        finally:
            shutil.rmtree(working, ignore_errors=True)


def _move(working: Path, out: Path, marker: str) -> None:
    """Move every file to its place, ``marker`` the last."""
    files = [path.relative_to(working) for path in working.rglob("*") if path.is_file()]
    for file in files:
        for folder in reversed(file.parents[:-1]):
            check_kind(out / folder, "folder", is_own=True)
        check_kind(out / file, "file")
    (out / marker).unlink(missing_ok=True)
    for file in sorted(files, key=lambda file: file == Path(marker)):
        with naming(out / file):
            (out / file).parent.mkdir(parents=True, exist_ok=True)
            os.replace(working / file, out / file)


@contextmanager
def _naming_target(working: Path, out: Path) -> Iterator[None]:
    """Let errors of the system name a file where it was to be."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            error.filename = str(error.filename).replace(str(working), str(out))
        raise


def own_folder(path: Path) -> Path:
    """Make a folder within one of results, where there is none, and return it.

    Raises:
        InputError: it is a link, which may lead elsewhere, or no folder.
        OSError: with its name.
    """
    check_kind(path, "folder", is_own=True)
    with naming(path):
        path.mkdir(parents=True, exist_ok=True)
        remove_left_behind(path)
    return path


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Let there be a folder; what was made for it and stays empty goes again."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        with naming(folder):
            folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for each in missing:
            with suppress(OSError):  # there is something in it
                each.rmdir()


# -- One process at a time ---------------------------------------------------------------------


@contextmanager
def alone_in(folder: Path, lock: Path | None = None, wait_s: float = 0.0) -> Iterator[None]:
    """Let no other process work in ``folder`` meanwhile.

    The system drops the lock when the process dies, however it dies. What this process holds it may
    take again. On a disk that knows no locks nothing is held.

    Args:
        folder: of the work.
        lock: file that is locked; by default one in ``folder``. Its folder is made if need be.
        wait_s: how long to wait for another process.

    Raises:
        InputError: another process works there; it is named.
        OSError: with the name of the lock.
    """
    path = lock or folder / _LOCK
    key = os.path.realpath(path)
    if key in _held:
        yield
        return
    with _made(path.parent):
        descriptor = _lock(path, folder, wait_s)
        _held.add(key)
        try:
            yield
        finally:
            _held.discard(key)
            with suppress(OSError):
                path.unlink()
            os.close(descriptor)


def lock_beside(path: Path) -> Path:
    """The lock of a folder that is moved to ``path`` when it is whole."""
    name = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]
    return path.parent / f".ms-slam-{name}.lock"


def _lock(path: Path, folder: Path, wait_s: float) -> int:
    """A descriptor of the locked file, with the name of this process in it."""
    until = time.monotonic() + wait_s
    while True:
        descriptor = open_own(path)
        try:
            if _is_locked(descriptor):
                if _is_at(path, descriptor):  # and not one that its holder has just removed
                    with suppress(OSError):  # a full disk
                        os.ftruncate(descriptor, 0)
                        os.write(descriptor, process_name().encode())
                    return descriptor
            elif time.monotonic() >= until:
                raise InputError(
                    f"{folder} is in use by {_holder(descriptor)}: wait until that has ended, or "
                    "choose another folder"
                )
            else:
                time.sleep(0.02)
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_locked(descriptor: int) -> bool:
    """Whether the lock could be taken."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a disk without locks
        pass
    return True


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.lstat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _holder(descriptor: int) -> str:
    """Who says in a lock file that it holds it."""
    said = re.fullmatch(
        r"([\w.-]{1,64})/(\d{1,10})/\w*", os.read(descriptor, 200).decode(errors="replace")
    )
    if said is None:
        return "another process"
    return f"process {said[2]}" + (f" of {said[1]}" if said[1] != socket.gethostname() else "")
