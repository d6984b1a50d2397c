"""What a full disk, a kill or a wrong place leaves behind: the old files or the new, never half."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ms_slam_env._runtime import output_files
from ms_slam_env._runtime.output_files import (
    append_line,
    check_out_file,
    check_out_folder,
    growing_file,
    new_file,
    write_bytes,
    write_text,
)
from ms_slam_env._runtime.result_folders import alone_in, own_folder, result_folder
from ms_slam_env.errors import InputError

WRITE = os.write


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Leave so many bytes on the disk: a write takes what fits, at most 7 bytes, then fails."""
    left = 0

    def write(descriptor: int, data: bytes) -> int:
        nonlocal left
        if not left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        taken = WRITE(descriptor, bytes(data[: min(left, 7)]))
        left -= taken
        return taken

    def leave(size: int) -> None:
        nonlocal left
        left = size

    monkeypatch.setattr(output_files.os, "write", write)
    return leave


def content(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else b"folder"
        for path in folder.rglob("*")
    }


def test_short_writes_are_continued(tmp_path: Path, disk: Callable[[int], None]) -> None:
    disk(1000)
    write_bytes(tmp_path / "new" / "a.bin", bytes(range(100)))
    append_line(tmp_path / "new" / "a.bin", b"123456789\n")  # without a line end so far
    append_line(tmp_path / "new" / "a.bin", b"abcdefghijk\n")
    with growing_file(tmp_path / "b.txt") as add:
        add("one line of more than seven bytes")
        assert (tmp_path / "b.txt").read_text() == "one line of more than seven bytes\n"
        add("two")
    assert (tmp_path / "b.txt").read_text() == "one line of more than seven bytes\ntwo\n"
    assert (tmp_path / "new" / "a.bin").read_bytes() == (
        bytes(range(11)) + b"123456789\nabcdefghijk\n"
    )


@pytest.mark.parametrize("space", [0, 5, 13])
@pytest.mark.parametrize("is_new", [True, False])
def test_what_does_not_fit_leaves_what_was(
    tmp_path: Path, disk: Callable[[int], None], space: int, is_new: bool
) -> None:
    path = tmp_path / "a.jsonl"
    if not is_new:
        path.write_text("first line\n")
    before = content(tmp_path)
    for write in (write_bytes, append_line):
        disk(space)
        with pytest.raises(OSError, match=r"No space left on device: .*a\.jsonl'") as caught:
            write(path, b"fourteen bytes and more\n")
        assert caught.value.filename == str(path)
        if write is append_line and is_new:
            before = {"a.jsonl": b""}
        assert content(tmp_path) == before
    disk(100)
    append_line(path, b"fits\n")
    assert path.read_text() == ("" if is_new else "first line\n") + "fits\n"


def test_a_file_is_on_disk_before_it_takes_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a power cut may leave a file of the new name and no content."""
    done: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(output_files.os, "fsync", lambda *to: (done.append("sync"), fsync(*to)))
    monkeypatch.setattr(output_files.os, "replace", lambda *to: (done.append("to"), replace(*to)))
    for write, expected in (
        (lambda path: write_bytes(path, b"x"), ["sync", "to"]),
        (lambda path: write_bytes(path, b"x", durable=False), ["to"]),
        (lambda path: append_line(path, b"x\n"), ["sync"]),
    ):
        done.clear()
        write(tmp_path / "a")
        assert done == expected


@pytest.mark.parametrize("length", [1, 65535, 65536, 70000, 200_000])
def test_a_torn_last_line_is_removed_however_long(tmp_path: Path, length: int) -> None:
    path = tmp_path / "a.jsonl"
    for whole in ("", "first\n", "first\nsecond\n"):
        path.write_text(whole + "x" * length)
        append_line(path, b"new\n")
        assert path.read_text() == whole + "new\n"


def test_the_limit_of_a_file_s_size_is_like_a_full_disk(tmp_path: Path) -> None:
    """Without privileges, and without a word of ours in between: the system's own short write."""
    code = """
import errno, resource, sys
from pathlib import Path
from ms_slam_env._runtime.output_files import DISK_ERRORS, append_line, write_bytes
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
path = Path(sys.argv[1])
for k in range(30):
    try:
        append_line(path, b"%029d\\n" % k)
    except OSError as error:
        assert k >= 3 and error.errno in DISK_ERRORS and error.filename == str(path), error
    else:
        assert k < 3
try:
    write_bytes(path.with_name("b"), bytes(101))
except OSError as error:
    assert error.errno == errno.EFBIG
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a")], check=True)
    assert (tmp_path / "a").read_text() == "".join(f"{k:029d}\n" for k in range(3))
    assert not (tmp_path / "b").exists()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True)
    except OSError as error:
        pytest.skip(f"no file system can be mounted: {error}")
    if done.returncode:
        pytest.skip(f"no file system can be mounted: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_disk_that_is_really_full(small_disk: Path) -> None:
    records, old = small_disk / "a.jsonl", small_disk / "old.json"
    write_text(old, "old")
    line = b"x" * 999 + b"\n"

    def fill() -> None:
        for _ in range(100):
            append_line(records, line)

    with pytest.raises(OSError, match=r"No space left") as caught:
        fill()
    assert caught.value.filename == str(records)
    assert set(records.read_bytes().splitlines(keepends=True)) == {line}
    with pytest.raises(OSError, match=r"No space left"), result_folder(small_disk, "m") as folder:
        write_bytes(folder / "large", bytes(40_000))
    with pytest.raises(OSError, match=r"old\.json"):
        write_text(old, "y" * 40_000)
    assert old.read_text() == "old"
    assert sorted(path.name for path in small_disk.iterdir()) == ["a.jsonl", "old.json"]


PRECIOUS = b"of the user, without an end of line"


def grow(path: Path, text: bytes) -> None:
    with growing_file(path) as add:
        add(text.decode().rstrip("\n"))


@pytest.mark.parametrize("link", [os.symlink, os.link])
@pytest.mark.parametrize("write", [write_bytes, grow, append_line])
def test_no_link_leads_what_is_written_to_another_file(
    tmp_path: Path, write: Callable[[Path, bytes], None], link: Callable[[Path, Path], None]
) -> None:
    victim, path = tmp_path / "victim", tmp_path / "out" / "report.html"
    victim.write_bytes(PRECIOUS)
    path.parent.mkdir()
    for name in ("report.html", "report.html.partial"):
        link(victim, path.with_name(name))
    if write is append_line:
        with pytest.raises(InputError, match=r"html (is a link to another|has other names)"):
            write(path, b"new\n")
    else:
        write(path, b"new\n")
        assert path.read_bytes() == b"new\n"
        assert not path.is_symlink()
    assert victim.read_bytes() == PRECIOUS


def test_no_linked_folder_takes_a_part_of_a_result(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write_result(out, "1")
    (out / "below" / "a.txt").unlink()
    (out / "below").rmdir()
    elsewhere.mkdir()
    (out / "below").symlink_to(elsewhere)
    with pytest.raises(InputError, match="below is a link to another folder"):
        write_result(out, "2")
    with pytest.raises(InputError, match="below is a link to another folder"):
        own_folder(out / "below")
    assert content(elsewhere) == {}
    assert (out / "result.json").read_text() == (out / "z.txt").read_text() == "1"


def test_a_name_may_be_as_long_as_the_system_takes(tmp_path: Path) -> None:
    write_bytes(tmp_path / ("n" * 250), b"x")
    append_line(tmp_path / ("n" * 250), b"y\n")
    with pytest.raises(OSError, match="File name too long"):
        write_bytes(tmp_path / ("n" * 300), b"x")
    assert [len(path.name) for path in tmp_path.iterdir()] == [250]


def write_often(path: str, byte: int) -> None:
    for _ in range(50):
        write_bytes(Path(path), bytes([byte]) * 1_000_000, durable=False)


def test_two_writers_do_not_tear_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_bytes(path, b"a" * 1_000_000)
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=write_often, args=(str(path), k)) for k in b"ab"]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        data = path.read_bytes()
        assert len(data) == 1_000_000
        assert data in (data[:1] * len(data),)
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert [found.name for found in tmp_path.iterdir()] == ["a.bin"]


def test_what_a_killed_process_left_of_a_file_is_removed(tmp_path: Path) -> None:
    code = """
import os, signal, sys
from pathlib import Path
from ms_slam_env._runtime.output_files import new_file
with new_file(Path(sys.argv[1]) / "a") as descriptor:
    os.write(descriptor, b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)])
    assert [data for name, data in content(tmp_path).items() if name.startswith(".")] == [b"half"]
    with new_file(tmp_path / "b"):  # what is being written stays
        write_bytes(tmp_path / "c", b"c")
    assert content(tmp_path) == {"b": b"", "c": b"c"}


# -- Folders of results ------------------------------------------------------------------------


def write_result(out: Path, text: str) -> None:
    with result_folder(out, "result.json") as folder:
        write_text(folder / "result.json", text)
        write_text(folder / "z.txt", text)
        write_text(folder / "below" / "a.txt", text)


def test_the_file_that_makes_a_result_count_comes_last_and_goes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "new" / "out"
    write_result(out, "1")
    (out / "rows.jsonl").write_text("is another's")
    expected = {"result.json": b"2", "z.txt": b"2", "below": b"folder", "below/a.txt": b"2"}
    seen = []
    replace = os.replace

    def look(source: Path, target: Path) -> None:
        if target.parent in (out, out / "below"):
            seen.append((target.name, (out / "result.json").exists()))
        replace(source, target)

    monkeypatch.setattr(output_files.os, "replace", look)
    write_result(out, "2")
    assert seen[-1] == ("result.json", False)
    assert not any(was_there for _, was_there in seen)
    assert content(out) == expected | {"rows.jsonl": b"is another's"}


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_a_result_that_fails_leaves_the_one_before(tmp_path: Path, error: BaseException) -> None:
    def fail(out: Path) -> None:
        with result_folder(out, "result.json") as folder:
            write_text(folder / "result.json", "2")
            write_text(folder / "z.txt", "2")
            raise error

    write_result(tmp_path / "out", "1")
    before = content(tmp_path / "out")
    for out in (tmp_path / "out", tmp_path / "never" / "made"):
        with pytest.raises(type(error)):
            fail(out)
    assert content(tmp_path / "out") == before
    assert not (tmp_path / "never").exists()


def test_an_error_names_the_file_where_it_was_to_be(
    tmp_path: Path, disk: Callable[[int], None]
) -> None:
    disk(3)
    with pytest.raises(OSError, match="No space") as caught, result_folder(tmp_path, "m") as folder:
        write_text(folder / "figure.png", "4444")
    assert caught.value.filename == str(tmp_path / "figure.png")


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    code = """
import os, signal, sys
from pathlib import Path
from ms_slam_env._runtime.output_files import write_text
from ms_slam_env._runtime.result_folders import result_folder
with result_folder(Path(sys.argv[1]), "result.json") as folder:
    write_text(folder / "result.json", "killed")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)])
    assert done.returncode == -signal.SIGKILL
    left = content(tmp_path)
    assert b"killed" in left.values()
    assert all(name.startswith(".") for name in left)  # which readers pass over
    write_result(tmp_path, "1")
    assert not any(name.startswith(".") for name in content(tmp_path))


# -- One process at a time ---------------------------------------------------------------------


HOLD = """
import sys
from pathlib import Path
from ms_slam_env._runtime.result_folders import alone_in
with alone_in(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has the folder ``out`` to itself."""
    words = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_the_second_process_says_which_is_the_first(
    tmp_path: Path, holder: subprocess.Popen[str]
) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match=f"out is in use by process {holder.pid}: "):
        alone_in(out).__enter__()
    holder.kill()  # the lock dies with it
    holder.wait()
    with alone_in(out), alone_in(out):
        assert content(out).keys() == {".ms-slam.lock"}
        write_result(out, "1")
    assert content(out).keys() == {"result.json", "z.txt", "below", "below/a.txt"}


def test_a_lock_goes_when_its_holder_is_done(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    with pytest.raises(InputError, match="in use"):
        alone_in(tmp_path / "out", wait_s=0.1).__enter__()
    threading.Timer(0.2, holder.stdin.close).start()  # type: ignore[union-attr]
    with alone_in(tmp_path / "out", wait_s=60):
        pass
    assert not any((tmp_path / "out").glob("*"))


def test_a_folder_that_was_made_for_nothing_goes_again(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), alone_in(tmp_path / "new" / "out"):
        raise RuntimeError
    assert content(tmp_path) == {}


def test_what_a_lock_file_says_is_not_trusted(tmp_path: Path) -> None:
    fcntl = pytest.importorskip("fcntl")
    with (tmp_path / ".ms-slam.lock").open("w+") as file:
        file.write("x/1/2\n\033[2J" * 9)
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="in use by another process: wait"):
            alone_in(tmp_path).__enter__()


# -- Where results may go ----------------------------------------------------------------------


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))  # a path in full may be too long


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (make_fifo, "a FIFO"),
        (make_socket, "a socket"),
        (lambda path: path.symlink_to(os.devnull), "a character device"),
        (lambda path: path.symlink_to("nowhere"), "a link to nothing"),
    ],
)
def test_nothing_is_written_to_a_special_file(
    tmp_path: Path, make: Callable[[Path], None], kind: str
) -> None:
    path = tmp_path / "special"
    make(path)
    before = path.lstat()[:7]  # without times: looking at a link may change when it was read
    for refused in (
        lambda: check_out_folder(path),
        lambda: check_out_folder(path / "below" / "it"),
        lambda: check_out_file(path),
        lambda: check_out_file(path / "below.txt"),
        lambda: write_bytes(path, b"x"),
        lambda: append_line(path, b"x\n"),
        lambda: growing_file(path).__enter__(),
    ):
        with pytest.raises(InputError, match=f"special is {kind}; a (file|folder) is needed"):
            refused()
    assert path.lstat()[:7] == before
    assert [child.name for child in tmp_path.iterdir()] == ["special"]


def test_folder_and_file_are_not_mixed_up(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is a file; a folder is needed"):
        check_out_folder(tmp_path / "file")
    with pytest.raises(InputError, match="file is a file; a folder is needed"):
        check_out_file(tmp_path / "file" / "report.html")
    with pytest.raises(InputError, match="is a folder; a file is needed"):
        check_out_file(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path, target_is_directory=True)
    for fine in (tmp_path, tmp_path / "new" / "below", tmp_path / "link", Path("results")):
        check_out_folder(fine)
    check_out_file(tmp_path / "file")
    check_out_file(Path("report.html"))


def test_a_folder_that_takes_no_files_is_refused(tmp_path: Path) -> None:
    code = """
import os, sys
from pathlib import Path
from ms_slam_env.errors import InputError
from ms_slam_env._runtime.output_files import check_out_folder
if os.geteuid() == 0:
    os.setgid(65534)
    os.setuid(65534)
try:
    check_out_folder(Path(sys.argv[1]))
except InputError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, "/proc/new"], capture_output=True, text=True, check=True
    )
    assert done.stdout == "/proc: nothing can be written there\n"
