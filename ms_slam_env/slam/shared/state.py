"""Objects whose state can be saved and restored bit-exactly."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any, ClassVar

from ms_slam_env.errors import InputError


class Stateful(ABC):
    """An object that can be saved and restored."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Return everything needed to continue bit-exactly, as NumPy arrays and plain values."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state that ``get_state`` of an identically constructed object returned."""

    def state_like(self) -> Any:
        """The template that ``state_check`` compares states with, from a fresh or reset object.

        A fresh state, except where later states look different.
        """
        return self.get_state()


class Saved(Stateful):
    """An object whose state consists of the attributes named in ``saved``.

    Arrays, plain values and lists of them are copied. A ``Stateful`` attribute, or a list of them,
    saves and restores itself. ``also_saved`` names what a subclass adds to the state itself.
    """

    saved: ClassVar[tuple[str, ...]] = ()
    also_saved: ClassVar[tuple[str, ...]] = ()

    def get_state(self) -> dict[str, Any]:
        """Copy the attributes, by their names without a leading underscore."""
        return {_key(name): _state_of(getattr(self, name)) for name in self.saved}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return {_key(name): _like_of(getattr(self, name)) for name in self.saved}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the attributes from a state.

        Raises:
            InputError: the state lacks some, so it belongs to something else; nothing has changed.
        """
        check_has(state, (*map(_key, self.saved), *self.also_saved), type(self).__name__)
        for name in self.saved:
            setattr(self, name, _restored(getattr(self, name), state[_key(name)]))


def check_has(state: Any, names: Iterable[str], kind: str) -> None:
    """Refuse a state that lacks one of ``names``.

    Raises:
        InputError: it names the ``kind`` of object and what is missing.
    """
    if not isinstance(state, Mapping):
        raise InputError(f"a {type(state).__name__} is not a saved state of {kind}")
    missing = [name for name in names if name not in state]
    if missing:
        raise InputError(f"not a saved state of {kind}: it lacks {', '.join(missing)}")


def _key(attribute: str) -> str:
    return attribute.lstrip("_")


def _state_of(value: Any) -> Any:
    if isinstance(value, Stateful):
        return value.get_state()
    if isinstance(value, list):
        return [_state_of(each) for each in value]
    return deepcopy(value)


def _like_of(value: Any) -> Any:
    if isinstance(value, Stateful):
        return value.state_like()
    if isinstance(value, list):
        return [_like_of(each) for each in value]
    return _state_of(value)


def _restored(value: Any, state: Any) -> Any:
    if isinstance(value, Stateful):
        value.set_state(state)
        return value
    if isinstance(value, list) and value and isinstance(value[0], Stateful):
        return [_restored(*pair) for pair in zip(value, state, strict=True)]
    return deepcopy(state)
