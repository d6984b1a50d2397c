"""Read untrusted files: only regular files of bounded size.

A pipe would block, a device would never end, and an unbounded file could fill the memory.
"""

from __future__ import annotations

import json
import os
import re
import stat
from pathlib import Path
from typing import Any

from ms_slam_env.errors import InputError

MAX_TEXT_BYTES = 64 * 1024 * 1024
"""Limit for a listing, a trajectory or a configuration; a day at 30 Hz takes a quarter."""

MAX_IMAGE_BYTES = 128 * 1024 * 1024
"""Limit for an image; 4096 x 4096 colour pixels of 16 bits need less without compression."""

MAX_MESH_BYTES = 2 * 1024 * 1024 * 1024
"""Limit for a mesh or a point cloud."""


def check_file(path: str | Path, kind: str, most_bytes: int) -> None:
    """Refuse a path that is not a regular file or is too large, before a library opens it.

    Args:
        path: the file.
        kind: kind of file in the error message, such as "trajectory" or "image".
        most_bytes: largest allowed size.

    Raises:
        InputError: refused; the message names the file.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError) as error:
        raise _unreadable(path, kind, error) from None
    _check(found, path, kind, most_bytes)


def read_bytes(path: str | Path, kind: str, most_bytes: int) -> bytes:
    """Read a file; refuses the same as `check_file`."""
    check_file(path, kind, most_bytes)
    try:
        # Non-blocking, since a pipe without writer may have replaced the file meanwhile.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            _check(os.fstat(descriptor), path, kind, most_bytes)
            size = os.fstat(descriptor).st_size
            data = file.read(size + 1)  # allocates as much as requested
            if len(data) > size:  # the file grew, or the system does not report its size
                data += file.read(most_bytes + 1 - len(data))
    except OSError as error:
        raise _unreadable(path, kind, error) from None
    if len(data) > most_bytes:
        raise _too_large(path, kind, most_bytes)
    return data


def read_text(path: str | Path, kind: str, most_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file, without a byte order mark; refuses the same as `check_file`.

    Raises:
        InputError: also for text that is not UTF-8.
    """
    try:
        return read_bytes(path, kind, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"cannot read {kind} {path}: not a text file in UTF-8") from None


def read_json(path: str | Path, kind: str, most_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Read a JSON file; refuses the same as `check_file`.

    Raises:
        InputError: also for invalid JSON, too deep nesting, or a number with thousands of digits.
    """
    return parse_json(read_text(path, kind, most_bytes), path)


def parse_json(text: str | bytes, path: str | Path) -> Any:
    """Parse JSON ``text`` that was read from file ``path``.

    Raises:
        InputError: as `read_json`.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise InputError(f"{path} is not a JSON file: it is nested too deeply") from None
    except ValueError as error:
        raise InputError(f"{path} is not a JSON file: {str(error).splitlines()[0]}") from None


_DECIMAL_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")


def words_of(line: str) -> list[str]:
    """Words of a line, separated by blanks, commas or semicolons.

    If blanks or semicolons already separate the numbers, a comma is a decimal mark.
    """
    words = (line.replace(";", " ") if ";" in line else line).split()
    if "," not in line:
        return words
    if len(words) > 1 and all(map(_DECIMAL_COMMA.fullmatch, words)):
        return [word.replace(",", ".") for word in words]
    return " ".join(words).replace(",", " ").split()


def is_named(path: Path) -> bool:
    """Whether the path exists, even as a broken link.

    A broken link is then an error when it is read, instead of a missing file.
    """
    return os.path.lexists(path)


def _check(found: os.stat_result, path: str | Path, kind: str, most_bytes: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"cannot read {kind} {path}: not a regular file")
    if found.st_size > most_bytes:
        raise _too_large(path, kind, most_bytes)


def _too_large(path: str | Path, kind: str, most_bytes: int) -> InputError:
    return InputError(f"cannot read {kind} {path}: larger than {most_bytes / 1e6:.0f} MB")


def _unreadable(path: str | Path, kind: str, error: OSError | ValueError) -> InputError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else error
    return InputError(f"cannot read {kind} {path}: {reason}")
