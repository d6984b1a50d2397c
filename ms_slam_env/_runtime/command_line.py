"""Command lines from dataclasses, with one-line errors and exit code 2 for bad input."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import select
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any, TypeVar

from ms_slam_env._runtime.interrupts import Interrupts, Terminated
from ms_slam_env._runtime.output_files import DISK_ERRORS, check_out_folder
from ms_slam_env.errors import InputError, InputWarning, one_line

T = TypeVar("T")

_FRAME = re.compile(r"[╭╮╰╯│─]+|-{4,}")  # dashes if the terminal is not UTF-8
_CLASS = re.compile(r"^Error parsing \w+: ")  # names our dataclass, which does not help users
_PROPOSAL = re.compile(r"^[│ ] +(--[a-z][\w-]*)", re.MULTILINE)


def parse(
    cls: type[T],
    arguments: Sequence[str] | None,
    prog: str,
    check_out: Callable[[Path], None] = check_out_folder,
    default: T | None = None,
) -> T:
    """Build dataclass ``cls`` from command-line ``arguments`` (the process's own if None).

    Options not given have the values of ``default`` or, without it, the dataclass's defaults.
    ``check_out`` checks the field ``out``, if there is one.

    Raises:
        InputError: invalid arguments, with tyro's message in one line; or an ``out`` that cannot be
            written to.
        SystemExit: with code 0 after ``--help``.
    """
    import tyro  # here, so that listing the commands does not wait for it

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            start = tyro.MISSING_NONPROP if default is None else default
            made = tyro.cli(cls, args=arguments, prog=prog, default=start)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise InputError(_one_line(complaint.getvalue())) from None
    out = getattr(made, "out", None)
    if out is not None:
        check_out(out)
    return made


def exit_code(run: Callable[[], int], name: str = "ms-slam") -> int:
    """Run a command; report errors, interrupts and warnings about input in one line each.

    Hides warnings of libraries, which do not help users.

    Returns:
        0 success, 1 failure (also of the disk), 2 bad input, 130 after Ctrl-C, 143 after SIGTERM,
        141 if nobody reads the output any more, as for other programs in a pipe.
    """
    _open_missing_streams()
    interrupts = Interrupts()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be valid text
    try:
        with interrupts, warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore", RuntimeWarning)
            warnings.simplefilter("default", InputWarning)
            warnings.showwarning = partial(_show_warning, name)
            try:
                code = run()
            except SystemExit:  # after --help
                _flush()
                raise
            _flush()
            return code
    except BaseException as error:
        if isinstance(error, BrokenPipeError) and _no_one_reads():
            return 128 + signal.SIGPIPE
        ending = _ending(error, interrupts.signal)
        if ending is None:
            raise
        code, text = ending
        with contextlib.suppress(OSError):  # an unread message must not change the exit code
            _close_bars()
            print(f"{name}: {one_line(text)}", file=sys.stderr)
        _no_one_reads()
        return code


def _open_missing_streams() -> None:
    """Open standard streams that were closed at the start of the process, to the null device.

    Python sets closed streams to None, which not all code expects. Also, the next file opened would
    get the stream's number, and everything that a library writes there.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, open until the process ends


def _no_one_reads() -> bool:
    """Whether an output is a pipe whose reader has gone; its remaining data is discarded."""
    gone = []
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # a stream without a file
            outputs = select.poll()
            outputs.register(stream.fileno(), 0)  # errors only
            gone += [stream] if outputs.poll(0) else []
    for stream in gone:
        _lead_nowhere(stream)
    return bool(gone)


def _lead_nowhere(stream: IO[str]) -> None:
    """Discard data left in a broken stream, so that it causes no error at exit."""
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def _close_bars() -> None:
    """Close progress bars that an error left open, or they would be redrawn below its message."""
    library = sys.modules.get("tqdm")
    for bar in list(getattr(library.tqdm, "_instances", ())) if library else ():
        bar.close()


def _ending(error: BaseException, stopped: int | None) -> tuple[int, str] | None:
    """Exit code and message for the error that ended a command; None if it is a program bug."""
    if stopped is not None or isinstance(error, KeyboardInterrupt):
        # After a signal, an interrupted library may raise anything.
        kept = str(error) if isinstance(error, KeyboardInterrupt) else ""
        number = stopped or (signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT)
        by = " by SIGTERM" if number == signal.SIGTERM else ""
        return 128 + number, f"interrupted{by}; {kept}" if kept else f"interrupted{by}"
    if isinstance(error, InputError):
        return 2, f"error: {error}"
    if isinstance(error, OSError):
        code = 1 if error.errno in DISK_ERRORS else 2
        name = error.filename or (_name_of_output() if code == 1 else None)
        if name is not None:
            return code, f"error: {name}: {error.strerror}"
    if isinstance(error, RuntimeError):
        return 1, f"error: {error}"
    return None


def _flush() -> None:
    """Flush standard output, so that an error shows now and not after the exit code is set."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _lead_nowhere(sys.stdout)
        raise OSError(errno.EIO, error.strerror, "standard output") from None


def _name_of_output() -> str:
    """Source of a disk error without a file name: standard output if writing to it fails, too."""
    try:
        sys.stdout.write("\n")
        _flush()
    except OSError:
        return "standard output"
    return "a file could not be written"


def _show_warning(
    name: str, message: Warning | str, category: type[Warning], *where: Any, **_: Any
) -> None:
    """Print a warning in one line; warnings of other packages include their origin."""
    ours = issubclass(category, InputWarning)
    place = "" if ours else f" ({category.__name__} in {where[0]}, line {where[1]})"
    print(f"{name}: warning: {one_line(message)}{place}", file=sys.stderr)


def for_a_page(folder: Path) -> str:
    """End of a line about written results: how to look at them."""
    return f"; for a page of them: ms-slam report {shlex.quote(str(folder))}"


def report_failures(errors: Sequence[str], name: str = "ms-slam") -> int:
    """Print how much work failed; return the exit code."""
    if errors:
        first = one_line(errors[0])
        print(f"{name}: error: {len(errors)} failed, the first: {first}", file=sys.stderr)
    return 1 if errors else 0


def _one_line(box: str) -> str:
    """The message in tyro's box: its lines up to the first rule, or its title if it has no rule.

    Similar options suggested by tyro are appended.
    """
    title, *lines = box.splitlines() or [""]
    _, _, proposals = box.partition("Perhaps you meant")
    similar = ", ".join(dict.fromkeys(_PROPOSAL.findall(proposals)))
    hint = f"; perhaps you meant {similar}" if similar else ""
    message: list[str] = []
    for line in lines:
        if any(message) and _FRAME.sub("", line).strip() == "":
            break
        message.append(_FRAME.sub("", line).strip())
    text = " ".join(filter(None, message)) or _FRAME.sub("", title).strip() or "bad arguments"
    return _CLASS.sub("", text) + hint
