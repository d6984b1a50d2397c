"""Errors that name the offending thing and the valid choices."""

from __future__ import annotations

import re
from collections.abc import Iterable

_HEAD, _TAIL = 1000, 500  # characters of a message; the choices come last
_SHOWN = 60, 20  # of what is quoted: its beginning, its end
_LONG = re.compile(
    r"""(?<!\w)(['"])(?:(?!\1).){200,}\1(?!\w) | [\[{][^][{}]{200,}[]}] | \S{300,}""", re.VERBOSE
)
"""A quotation, a list or a word that is longer than most paths."""


def one_line(text: object) -> str:
    """``text`` without line breaks, and of long quotations and words the ends alone.

    What is quoted, from a file or an option, may have megabytes.
    """
    line = str(text)
    if len(line) > _HEAD + _TAIL:
        line = f"{line[:_HEAD]}...{line[-_TAIL:]}"
    line = " ".join(part.strip() for part in line.splitlines())
    return _LONG.sub(lambda found: f"{found[0][: _SHOWN[0]]}...{found[0][-_SHOWN[1] :]}", line)


class InputError(ValueError):
    """A value given by the user is wrong; the message is one line fit to be shown as it is.

    Line breaks in what is quoted, as of a name or an array, become spaces; see `one_line`.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class InputWarning(UserWarning):
    """Something that a user gave is taken, but hardly meant; one line, as of `InputError`."""


class UnreachableError(InputError):
    """The camera cannot be held at a pose."""


def unknown(kind: str, name: object, choices: Iterable[object]) -> InputError:
    """Return the error for an unknown ``name`` of some ``kind``, listing the valid ``choices``."""
    valid = ", ".join(str(choice) for choice in choices)
    return InputError(f"unknown {kind} {str(name)!r}; valid choices: {valid}")
