"""Command lines from dataclasses: errors of one line, exit code 2 for bad input."""

from __future__ import annotations

import contextlib
import io
import re
import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

import tyro

from ms_slam_env.errors import InputError

T = TypeVar("T")

_FRAME = re.compile(r"[╭╮╰╯│─]+")


def parse(cls: type[T], arguments: Sequence[str] | None, prog: str) -> T:
    """Build dataclass ``cls`` from command-line ``arguments`` (the process's own if None).

    Raises:
        InputError: arguments that do not fit; what tyro says in a box, in one line.
        SystemExit: with code 0 after ``--help``.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(cls, args=arguments, prog=prog)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise InputError(_one_line(complaint.getvalue())) from None


def exit_code(run: Callable[[], int], name: str = "ms-slam") -> int:
    """Run a command: 0 success, 1 failure, 2 bad input, 130 interrupt; errors in one line."""
    try:
        return run()
    except InputError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: interrupted; finished work is kept", file=sys.stderr)
        return 130


def report_failures(errors: Sequence[str], name: str = "ms-slam") -> int:
    """Print how much work failed; return the exit code."""
    if errors:
        print(f"{name}: error: {len(errors)} failed, the first: {errors[0]}", file=sys.stderr)
    return 1 if errors else 0


def _one_line(box: str) -> str:
    """The message of tyro's box: its lines up to the first rule, or its title without any."""
    title, *lines = box.splitlines() or [""]
    message: list[str] = []
    for line in lines:
        if message and _FRAME.sub("", line).strip() == "":
            break
        message.append(_FRAME.sub("", line).strip())
    return " ".join(filter(None, message)) or _FRAME.sub("", title).strip() or "bad arguments"
