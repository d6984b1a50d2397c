"""Files that are whole or not there, and results that count once their last file is in place.

Whatever the package writes goes through here, so that a full disk costs what was being written and
nothing else, and is one error that names the file.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ms_slam_env.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: one process at a time
    fcntl = None  # type: ignore[assignment]

_KINDS: dict[str, Callable[[int], bool]] = {
    "file": stat.S_ISREG,
    "folder": stat.S_ISDIR,
    "character device": stat.S_ISCHR,
    "block device": stat.S_ISBLK,
    "FIFO": stat.S_ISFIFO,
    "socket": stat.S_ISSOCK,
}
_WORKING = ".partial-"
DISK_ERRORS = {
    getattr(errno, name)
    for name in ("ENOSPC", "EDQUOT", "EFBIG", "EIO", "EROFS")
    if hasattr(errno, name)
}
"""Numbers of the errors of a disk that is full, over quota, broken or read-only."""


# -- Files -------------------------------------------------------------------------------------


def write_bytes(path: Path, data: bytes, durable: bool = True) -> None:
    """Write a file; whatever goes wrong leaves the old one or the new one, never half of one.

    Its folder is made if it is not there.

    Args:
        path: of the file.
        data: all of it.
        durable: whether it is on disk when this returns, also if the power fails; slow for many.

    Raises:
        InputError: ``path`` is a device or the like, which a file would replace.
        OSError: with the name of the file: no space, no right, a broken disk.
    """
    _check_kind(path, "file")
    partial = path.with_name(path.name + ".partial")
    try:
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
            try:
                _write(descriptor, data)
                if durable:
                    os.fsync(descriptor)
            finally:
                os.close(descriptor)
            os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of ``text`` in UTF-8."""
    write_bytes(path, text.encode("utf-8", errors="replace"))


def make_file(path: Path) -> None:
    """Make an empty file where there is none, for libraries that write it themselves.

    Raises:
        InputError: ``path`` is a device or the like.
        OSError: with the name of the file: no space, no right, a read-only disk.
    """
    _check_kind(path, "file")
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o666))


@contextmanager
def growing_file(path: Path) -> Iterator[Callable[[str], None]]:
    """A new text file; what is given adds a line to it, which is there at once.

    Raises:
        InputError: ``path`` is a device or the like.
        OSError: with the name of the file.
    """
    _check_kind(path, "file")
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)

    def add(line: str) -> None:
        with naming(path):
            _write(descriptor, f"{line}\n".encode())

    try:
        yield add
    finally:
        os.close(descriptor)


def append_line(path: Path, line: bytes) -> None:
    """Add a line, end included, to a file; it is on disk when this returns.

    A line that does not fit leaves the file as it was. A last line without an end, which a kill cut
    short, is removed first. Several processes may append to one file.

    Raises:
        InputError: ``path`` is a device or the like.
        OSError: with the name of the file.
    """
    _check_kind(path, "file")
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                with suppress(OSError):  # a disk without locks
                    fcntl.flock(descriptor, fcntl.LOCK_EX)
            length = _whole_lines(descriptor)
            os.ftruncate(descriptor, length)
            try:
                _write(descriptor, line)
                os.fsync(descriptor)
            except BaseException:
                os.ftruncate(descriptor, length)
                raise
        finally:
            os.close(descriptor)


def _whole_lines(descriptor: int) -> int:
    """Bytes up to the end of the last line that has one."""
    length = os.lseek(descriptor, 0, os.SEEK_END)
    while length:
        start = max(0, length - 65536)
        os.lseek(descriptor, start, os.SEEK_SET)
        end = os.read(descriptor, length - start).rfind(b"\n")
        if end >= 0:
            return start + end + 1
        length = start
    return 0


def _write(descriptor: int, data: bytes) -> None:
    """Write all of it; one call may take less, as on a disk that is nearly full."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let errors of the system in here name ``path``, whatever file they happened at."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


# -- Folders of results ------------------------------------------------------------------------


@contextmanager
def result_folder(out: Path, marker: str) -> Iterator[Path]:
    """A folder to write a result into, whose files then move into ``out``, ``marker`` the last.

    Who finds the marker finds the whole result. What fails or is interrupted before leaves ``out``
    as it was. The working folder lies in ``out``: on the same disk, under the same rights.

    Args:
        out: of the result; made if it is not there.
        marker: name of the file that makes the others count.

    Raises:
        OSError: with the name of the file.
    """
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    prefix = f"{_WORKING}{socket.gethostname()}-"
    working = out / f"{prefix}{os.getpid()}"
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
        _remove_left_behind(out, prefix)
        working.mkdir()
    try:
        yield working
        (out / marker).unlink(missing_ok=True)
        files = [path for path in working.rglob("*") if path.is_file()]
        for path in sorted(files, key=lambda path: path == working / marker):
            target = out / path.relative_to(working)
            _check_kind(target, "file")
            with naming(target):
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(path, target)
        missing = []
    except OSError as error:
        if error.filename is not None:  # where the file was to be
            error.filename = str(error.filename).replace(str(working), str(out))
        raise
    finally:
        shutil.rmtree(working, ignore_errors=True)
        for folder in missing:
            if not any(folder.iterdir()):
                folder.rmdir()


def _remove_left_behind(out: Path, prefix: str) -> None:
    """Remove the working folders of processes of this machine that were killed."""
    processes = Path("/proc")
    for folder in out.glob(f"{prefix}*"):
        number = folder.name.removeprefix(prefix)
        is_own = number == str(os.getpid())  # of one before, under the same number
        is_dead = (processes / "self").exists() and not (processes / number).exists()
        if is_own or is_dead:
            shutil.rmtree(folder, ignore_errors=True)


# -- Where results may go ----------------------------------------------------------------------


def check_out_folder(path: Path) -> None:
    """Refuse, before any work, what cannot be or become a folder with results.

    Raises:
        InputError: it or what it lies in is a file, a device or the like, or takes no files.
    """
    there = next((p for p in (path, *path.parents) if os.path.lexists(p)), Path())
    _check_kind(there, "folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{there}: nothing can be written there")


def check_out_file(path: Path) -> None:
    """The same of a file.

    Raises:
        InputError: it is a folder, a device or the like, or its folder takes no files.
    """
    _check_kind(path, "file")
    check_out_folder(path.parent)


def _check_kind(path: Path, wanted: str) -> None:
    """Refuse what is there already and is something else."""
    if not os.path.lexists(path):
        return
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise InputError(f"{path} is a link to nothing; a {wanted} is needed") from None
    kind = next((name for name, fits in _KINDS.items() if fits(mode)), "special file")
    if kind != wanted:
        raise InputError(f"{path} is a {kind}; a {wanted} is needed")
