"""Files that a user names or a stranger wrote: regular ones of bounded size, and nothing else.

A pipe would block, a device never end, and a file of any size fill the memory.
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
"""Of a listing, a trajectory or a configuration: a day of frames at 30 Hz has a quarter of it."""

MAX_IMAGE_BYTES = 128 * 1024 * 1024
"""Of an image file: more than 4096 x 4096 pixels of colour at 16 bits need without compression."""

MAX_MESH_BYTES = 2 * 1024 * 1024 * 1024
"""Of a mesh or a cloud."""


def check_file(path: str | Path, kind: str, most_bytes: int) -> None:
    """Refuse what is no regular file or too large, for libraries that open files themselves.

    Args:
        path: of the file.
        kind: of file, for the error message: "trajectory", "image".
        most_bytes: largest size.

    Raises:
        InputError: naming the file.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError) as error:
        raise _unreadable(path, kind, error) from None
    _check(found, path, kind, most_bytes)


def read_bytes(path: str | Path, kind: str, most_bytes: int) -> bytes:
    """What a file holds; see `check_file`."""
    check_file(path, kind, most_bytes)
    try:
        # Not blocking: what took the file's place since may be a pipe that nobody writes to.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            _check(os.fstat(descriptor), path, kind, most_bytes)
            size = os.fstat(descriptor).st_size
            data = file.read(size + 1)  # as much is allocated as is asked for
            if len(data) > size:  # it grew meanwhile, or the system does not tell its size
                data += file.read(most_bytes + 1 - len(data))
    except OSError as error:
        raise _unreadable(path, kind, error) from None
    if len(data) > most_bytes:
        raise _too_large(path, kind, most_bytes)
    return data


def read_text(path: str | Path, kind: str, most_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a file in UTF-8, without the mark that may begin it; see `check_file`.

    Raises:
        InputError: also what is no UTF-8.
    """
    try:
        return read_bytes(path, kind, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"cannot read {kind} {path}: not a text file in UTF-8") from None


def read_json(path: str | Path, kind: str, most_bytes: int = MAX_TEXT_BYTES) -> Any:
    """What a JSON file holds; see `check_file`.

    Raises:
        InputError: also what is no JSON, is nested too deeply, or has a number of thousands of
            digits.
    """
    return parse_json(read_text(path, kind, most_bytes), path)


def parse_json(text: str | bytes, path: str | Path) -> Any:
    """What the JSON text of file ``path`` says.

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
    """Words of a line between blanks, commas or semicolons.

    Between numbers that blanks or semicolons separate already, a comma is a decimal mark.
    """
    words = (line.replace(";", " ") if ";" in line else line).split()
    if "," not in line:
        return words
    if len(words) > 1 and all(map(_DECIMAL_COMMA.fullmatch, words)):
        return [word.replace(",", ".") for word in words]
    return " ".join(words).replace(",", " ").split()


def is_named(path: Path) -> bool:
    """Whether something has this name, a link that leads nowhere included.

    What has a name is meant to be read, so that a link that broke is an error and not an absence.
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
