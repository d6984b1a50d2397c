"""Options of a command from a dataclass, with errors of one line."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import TypeVar

import tyro

from ms_slam_env.errors import InputError

T = TypeVar("T")

_FRAME = re.compile(r"[╭╮╰╯│─]+")


def parse(cls: type[T], arguments: Sequence[str], prog: str) -> T:
    """Build dataclass ``cls`` from command-line ``arguments``.

    Raises:
        InputError: arguments that do not fit; what tyro says in a box, in one line.
        SystemExit: with code 0 after ``--help``.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(cls, args=list(arguments), prog=prog)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise InputError(_one_line(complaint.getvalue())) from None


def _one_line(box: str) -> str:
    """The message of tyro's box: its lines up to the first rule, or its title without any."""
    title, *lines = box.splitlines() or [""]
    message: list[str] = []
    for line in lines:
        if message and _FRAME.sub("", line).strip() == "":
            break
        message.append(_FRAME.sub("", line).strip())
    return " ".join(filter(None, message)) or _FRAME.sub("", title).strip() or "bad arguments"
