"""Errors that name the offending thing and the valid choices."""

from __future__ import annotations

import re
from collections.abc import Iterable

_HEAD, _TAIL = 1000, 500  # characters kept of a message; the choices come last
_SHOWN = 60, 20  # characters kept of a long quotation: at its beginning, at its end
_LONG = re.compile(
    r"""(?<!\w)(['"])(?:(?!\1).){200,}\1(?!\w) | [\[{][^][{}]{200,}[]}] | \S{300,}""", re.VERBOSE
)
"""A quotation, a list or a word that is longer than most paths."""


def one_line(text: object) -> str:
    """Put ``text`` on one line, and keep only the ends of long quotations and words.

    Text quoted from a file or an option may have megabytes.
    """
    line = str(text)
    if len(line) > _HEAD + _TAIL:
        line = f"{line[:_HEAD]}...{line[-_TAIL:]}"
    line = " ".join(part.strip() for part in line.splitlines())
    return _LONG.sub(lambda found: f"{found[0][: _SHOWN[0]]}...{found[0][-_SHOWN[1] :]}", line)


class InputError(ValueError):
    """A value given by the user is wrong; the message is one line, ready to be shown.

    Line breaks in quoted text, such as a name or an array, become spaces; see `one_line`.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


class InputWarning(UserWarning):
    """A value is accepted but probably not intended; one line, as for `InputError`."""


class UnreachableError(InputError):
    """The camera cannot be held at a pose."""


def unknown(kind: str, name: object, choices: Iterable[object]) -> InputError:
    """Return the error for an unknown ``name`` of some ``kind``, listing the valid ``choices``."""
    valid = ", ".join(str(choice) for choice in choices)
    return InputError(f"unknown {kind} {str(name)!r}; valid choices: {valid}")
