"""Files that are whole or not there, and results that count once their last file is in place.

Whatever the package writes goes through here, so that a full disk costs what was being written and
nothing else, and is one error that names the file. A folder of results may come from a stranger:
no link in it leads what is written to another place.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
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
_OWN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
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
    with new_file(path, durable) as descriptor:
        _write(descriptor, data)


@contextmanager
def new_file(path: Path, durable: bool = True) -> Iterator[int]:
    """A descriptor to write to; the file takes its place ``path`` at the end, or never.

    It grows under a name that was not there before, so that two writers do not meet and no link is
    followed: one at ``path`` is replaced. See `write_bytes`.
    """
    check_kind(path, "file")
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if durable:  # images by the thousand do not look through their folder for each
            remove_left_behind(path.parent)
        partial = working_name(path.parent)
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _OWN, 0o666)
        try:
            try:
                yield descriptor
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


@contextmanager
def growing_file(path: Path) -> Iterator[Callable[[str], None]]:
    """A new text file; what is given adds a line to it, which is there at once.

    Raises:
        InputError: ``path`` is a device or the like.
        OSError: with the name of the file.
    """
    write_bytes(path, b"", durable=False)
    descriptor = open_own(path)

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
        InputError: ``path`` is a device or the like, or has other names.
        OSError: with the name of the file.
    """
    descriptor = open_own(path, os.O_APPEND)
    with naming(path):
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


def open_own(path: Path, flags: int = 0) -> int:
    """A descriptor of a file to read and change, new or there already; see `check_own`.

    Raises:
        InputError: see there.
        OSError: with the name of the file.
    """
    check_own(path)
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, os.O_RDWR | os.O_CREAT | _OWN | flags, 0o666)


def check_own(path: Path) -> None:
    """Refuse a file to be changed in its place that is reached by other names, too.

    Raises:
        InputError: a link, of either sort, which would lead what is written to another place; a
            device or the like.
    """
    check_kind(path, "file", is_own=True)
    with suppress(FileNotFoundError):
        if os.lstat(path).st_nlink > 1:
            raise InputError(f"{path} has other names (hard links); a file of its own is needed")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let errors of the system in here name ``path``, whatever file they happened at."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def working_name(folder: Path) -> Path:
    """A new name in ``folder`` that says which process works there."""
    process = process_name().replace("/", "-")
    return folder / f"{_WORKING}{process}-{secrets.token_hex(8)}"


def remove_left_behind(folder: Path) -> None:
    """Remove what processes of this machine that were killed were writing in ``folder``."""
    host = socket.gethostname()
    form = re.compile(rf"{re.escape(_WORKING + host)}-(\d+)-(\w*)-\w+")
    found = []
    with suppress(OSError), os.scandir(folder) as entries:  # a folder that cannot be listed
        found = [(entry, form.fullmatch(entry.name)) for entry in entries]
    for entry, name in found:
        if name is None or is_alive(f"{host}/{name[1]}/{name[2]}"):
            continue
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, ignore_errors=True)
        else:
            with suppress(OSError):
                os.unlink(entry.path)


# -- Which process works on something, and whether it still lives -------------------------------


def process_name(pid: int | None = None) -> str:
    """Name of process ``pid`` (this one if None): host, number, and when it began."""
    pid = os.getpid() if pid is None else pid
    return f"{socket.gethostname()}/{pid}/{_start_of(pid)}"


def is_alive(name: str) -> bool:
    """Whether the process called ``name`` lives on this host.

    Studies lie on one machine: the process of another host is one from before a container was
    started anew, under a new name.
    """
    host, pid, start = name.rsplit("/", 2)
    if host != socket.gethostname():
        return False
    try:
        if int(pid) < 1:  # a group of processes
            return False
        os.kill(int(pid), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # it lives, and is another user's
    return _start_of(int(pid)) == start


def _start_of(pid: int) -> str:
    """Start of a process in clock ticks since boot, from proc(5); empty where there is no proc.

    Numbers of processes are used again. A process that ended and was not waited for counts as none.
    """
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "ended" if after_name[0] in "ZX" else after_name[19]


# -- Where results may go ----------------------------------------------------------------------


def check_out_folder(path: Path) -> None:
    """Refuse, before any work, what cannot be or become a folder with results.

    Raises:
        InputError: it or what it lies in is a file, a device or the like, or takes no files.
    """
    there = next((p for p in (path, *path.parents) if os.path.lexists(p)), Path())
    check_kind(there, "folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{there}: nothing can be written there")


def check_out_file(path: Path) -> None:
    """The same of a file.

    Raises:
        InputError: it is a folder, a device or the like, or its folder takes no files.
    """
    check_kind(path, "file")
    check_out_folder(path.parent)


def check_kind(path: Path, wanted: str, is_own: bool = False) -> None:
    """Refuse what is there already and is something else; if it must be one's own, a link, too."""
    if not os.path.lexists(path):
        return
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise InputError(f"{path} is a link to nothing; a {wanted} is needed") from None
    kind = next((name for name, fits in _KINDS.items() if fits(mode)), "special file")
    if kind != wanted:
        raise InputError(f"{path} is a {kind}; a {wanted} is needed")
    if is_own and path.is_symlink():
        raise InputError(f"{path} is a link to another {wanted}; one of its own is needed")
