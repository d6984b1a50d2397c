"""Folders of results, written atomically and by one process at a time."""

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
_MOVING_S = 60.0  # longest time for another process to move a result into place
_held: set[str] = set()  # locks of this process


@contextmanager
def result_folder(out: Path, marker: str) -> Iterator[Path]:
    """A temporary folder to write a result into; its files then move to ``out``, ``marker`` last.

    If the marker exists, the result is complete. A failure or interrupt before that leaves ``out``
    unchanged. The temporary folder is inside ``out``: on the same disk, with the same permissions.

    Args:
        out: folder of the result; created if missing.
        marker: name of the file whose presence means that the result is complete.

    Raises:
        InputError: a link in ``out`` leads elsewhere.
        OSError: a file cannot be written; the message names it.
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
    """Move every file to its place, ``marker`` last."""
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
    """Let system errors name a file by its final path."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            error.filename = str(error.filename).replace(str(working), str(out))
        raise


def own_folder(path: Path) -> Path:
    """Create a folder inside a folder of results, if missing, and return it.

    Raises:
        InputError: it is a link, which may lead elsewhere, or not a folder.
        OSError: it cannot be created; the message names it.
    """
    check_kind(path, "folder", is_own=True)
    with naming(path):
        path.mkdir(parents=True, exist_ok=True)
        remove_left_behind(path)
    return path


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Create a folder for the context; folders created for it that stay empty are removed."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        with naming(folder):
            folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for each in missing:
            with suppress(OSError):  # it is not empty
                each.rmdir()


# -- One process at a time ---------------------------------------------------------------------


@contextmanager
def alone_in(folder: Path, lock: Path | None = None, wait_s: float = 0.0) -> Iterator[None]:
    """Keep other processes from working in ``folder`` during the context.

    The system releases the lock when the process dies, in whatever way. This process may take its
    lock again. On a file system without locks, nothing is locked.

    Args:
        folder: folder of the work.
        lock: file to lock; by default one in ``folder``. Its folder is created if missing.
        wait_s: how long to wait for another process, seconds.

    Raises:
        InputError: another process works there; the message names it.
        OSError: the lock cannot be used; the message names it.
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
    """The lock of a folder that is moved to ``path`` once it is complete."""
    name = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]
    return path.parent / f".ms-slam-{name}.lock"


def _lock(path: Path, folder: Path, wait_s: float) -> int:
    """Lock the file, write this process's name into it, and return its descriptor."""
    until = time.monotonic() + wait_s
    while True:
        descriptor = open_own(path)
        try:
            if _is_locked(descriptor):
                if _is_at(path, descriptor):  # not a lock that its holder has just removed
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
    except OSError:  # a file system without locks
        pass
    return True


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.lstat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _holder(descriptor: int) -> str:
    """Name of the process that holds a lock file, as written in it."""
    said = re.fullmatch(
        r"([\w.-]{1,64})/(\d{1,10})/\w*", os.read(descriptor, 200).decode(errors="replace")
    )
    if said is None:
        return "another process"
    return f"process {said[2]}" + (f" of {said[1]}" if said[1] != socket.gethostname() else "")
