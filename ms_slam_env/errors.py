"""Errors that name the offending thing and the valid choices."""

from __future__ import annotations

from collections.abc import Iterable


class InputError(ValueError):
    """A value given by the user is wrong; the message is one line fit to be shown as it is.

    Line breaks in what is quoted, as of a name or an array, become spaces.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(" ".join(line.strip() for line in str(message).splitlines()))


class InputWarning(UserWarning):
    """Something that a user gave is taken, but hardly meant; one line, as of `InputError`."""


class UnreachableError(InputError):
    """The camera cannot be held at a pose."""


def unknown(kind: str, name: object, choices: Iterable[object]) -> InputError:
    """Return the error for an unknown ``name`` of some ``kind``, listing the valid ``choices``."""
    valid = ", ".join(str(choice) for choice in choices)
    return InputError(f"unknown {kind} {str(name)!r}; valid choices: {valid}")
