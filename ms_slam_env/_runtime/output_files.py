"""Write files atomically; results count once their last file is in place.

All files that the package writes go through here. A full disk then loses only the file being
written, and gives one error that names it. A folder of results may be untrusted, so no link in it
can redirect what is written.
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
"""Error numbers of a disk that is full, over quota, broken or read-only."""


# -- Files -------------------------------------------------------------------------------------


def write_bytes(path: Path, data: bytes, durable: bool = True) -> None:
    """Write a file atomically: a failure leaves the old or the new file, never a part.

    Creates its folder if missing.

    Args:
        path: the file.
        data: its whole content.
        durable: whether it must be on disk, safe against power loss, when this returns; slow for
            many files.

    Raises:
        InputError: ``path`` is a special file such as a device, which a file would replace.
        OSError: no space, no permission or a broken disk; the message names the file.
    """
    with new_file(path, durable) as descriptor:
        _write(descriptor, data)


@contextmanager
def new_file(path: Path, durable: bool = True) -> Iterator[int]:
    """A descriptor to write to; the file is moved to ``path`` at the end, or not at all.

    It is written under a new name, so that two writers do not collide and no link is followed; a
    link at ``path`` is replaced. See `write_bytes`.
    """
    check_kind(path, "file")
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if durable:  # thousands of images should not each scan their folder
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
    """Write ``text`` in UTF-8 with `write_bytes`."""
    write_bytes(path, text.encode("utf-8", errors="replace"))


@contextmanager
def growing_file(path: Path) -> Iterator[Callable[[str], None]]:
    """Create a text file and return a function that appends a line, which is written at once.

    Raises:
        InputError: ``path`` is a special file such as a device.
        OSError: the file cannot be written; the message names it.
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
    """Append a line, including its line end, to a file; it is on disk when this returns.

    If the line does not fit on the disk, the file is unchanged. A last line without line end, cut
    short by a kill, is removed first. Several processes may append to one file.

    Raises:
        InputError: ``path`` is a special file such as a device, or has other names.
        OSError: the file cannot be written; the message names it.
    """
    descriptor = open_own(path, os.O_APPEND)
    with naming(path):
        try:
            if fcntl is not None:
                with suppress(OSError):  # a file system without locks
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
    """Number of bytes up to the end of the last complete line."""
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
    """Write all data; a single call may write less, for example on a nearly full disk."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def open_own(path: Path, flags: int = 0) -> int:
    """Open a new or existing file to read and change; see `check_own`.

    Raises:
        InputError: as `check_own`.
        OSError: the file cannot be opened; the message names it.
    """
    check_own(path)
    with naming(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        return os.open(path, os.O_RDWR | os.O_CREAT | _OWN | flags, 0o666)


def check_own(path: Path) -> None:
    """Refuse to change a file in place if it has other names.

    Raises:
        InputError: a symbolic or hard link, which would redirect what is written, or a special
            file such as a device.
    """
    check_kind(path, "file", is_own=True)
    with suppress(FileNotFoundError):
        if os.lstat(path).st_nlink > 1:
            raise InputError(f"{path} has other names (hard links); a file of its own is needed")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let system errors in this context name ``path``, whichever file caused them."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def working_name(folder: Path) -> Path:
    """A new name in ``folder`` that contains the name of this process."""
    process = process_name().replace("/", "-")
    return folder / f"{_WORKING}{process}-{secrets.token_hex(8)}"


def remove_left_behind(folder: Path) -> None:
    """Remove unfinished files in ``folder`` of killed processes of this machine."""
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


# -- Names of processes, and whether they are alive ---------------------------------------------


def process_name(pid: int | None = None) -> str:
    """Name of process ``pid`` (this one if None): host, process number, and start time."""
    pid = os.getpid() if pid is None else pid
    return f"{socket.gethostname()}/{pid}/{_start_of(pid)}"


def is_alive(name: str) -> bool:
    """Whether the process called ``name`` is alive on this host.

    A study stays on one machine, so another host name comes from before a restart of the container,
    and such a process counts as dead.
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
        pass  # alive, but of another user
    return _start_of(int(pid)) == start


def _start_of(pid: int) -> str:
    """Start of a process in clock ticks since boot, from proc(5); empty without proc.

    It is needed because process numbers are reused. A zombie process counts as ended.
    """
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "ended" if after_name[0] in "ZX" else after_name[19]


# -- Where results may go ----------------------------------------------------------------------


def check_out_folder(path: Path) -> None:
    """Refuse, before any work, a path that cannot be or become a folder with results.

    Raises:
        InputError: the path or its nearest existing parent is not a folder, or is not writable.
    """
    there = next((p for p in (path, *path.parents) if os.path.lexists(p)), Path())
    check_kind(there, "folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{there}: nothing can be written there")


def check_out_file(path: Path) -> None:
    """Refuse, before any work, a path that cannot become an output file.

    Raises:
        InputError: the path is a folder or a special file, or its folder is not writable.
    """
    check_kind(path, "file")
    check_out_folder(path.parent)


def check_kind(path: Path, wanted: str, is_own: bool = False) -> None:
    """Refuse an existing path of another kind than ``wanted``; with ``is_own``, also a link."""
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
