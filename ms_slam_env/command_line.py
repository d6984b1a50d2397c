"""Command lines from dataclasses: errors of one line, exit code 2 for bad input."""

from __future__ import annotations

import contextlib
import io
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import tyro

from ms_slam_env.errors import InputError, InputWarning

T = TypeVar("T")

_FRAME = re.compile(r"[╭╮╰╯│─]+|-{4,}")  # dashes where the terminal is not UTF-8
_CLASS = re.compile(r"^Error parsing \w+: ")  # names our dataclass, which tells a user nothing
_PROPOSAL = re.compile(r"^[│ ] +(--[a-z][\w-]*)", re.MULTILINE)


def parse(cls: type[T], arguments: Sequence[str] | None, prog: str, default: T | None = None) -> T:
    """Build dataclass ``cls`` from command-line ``arguments`` (the process's own if None).

    What they do not say is as in ``default``, by default as the dataclass has it.

    Raises:
        InputError: arguments that do not fit; what tyro says in a box, in one line.
        SystemExit: with code 0 after ``--help``.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            start = tyro.MISSING_NONPROP if default is None else default
            return tyro.cli(cls, args=arguments, prog=prog, default=start)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise InputError(_one_line(complaint.getvalue())) from None


def exit_code(run: Callable[[], int], name: str = "ms-slam") -> int:
    """Run a command: 0 success, 1 failure, 2 bad input, 130 interrupt; errors in one line.

    So are warnings about what was given; those of libraries tell a user nothing.
    """
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                warnings.simplefilter("ignore", RuntimeWarning)
            warnings.simplefilter("default", InputWarning)
            warnings.showwarning = partial(_show_warning, name)
            return run()
    except InputError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.filename is None:
            raise  # not about a file that the user named
        print(f"{name}: error: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: interrupted; finished work is kept", file=sys.stderr)
        return 130


def _show_warning(
    name: str, message: Warning | str, category: type[Warning], *where: Any, **_: Any
) -> None:
    """Print a warning in one line; others than ours say where they come from."""
    ours = issubclass(category, InputWarning)
    place = "" if ours else f" ({category.__name__} in {where[0]}, line {where[1]})"
    print(f"{name}: warning: {message}{place}", file=sys.stderr)


def report_failures(errors: Sequence[str], name: str = "ms-slam") -> int:
    """Print how much work failed; return the exit code."""
    if errors:
        print(f"{name}: error: {len(errors)} failed, the first: {errors[0]}", file=sys.stderr)
    return 1 if errors else 0


def _one_line(box: str) -> str:
    """The message of tyro's box: its lines up to the first rule, or its title without any.

    The options that tyro finds similar follow the message.
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
