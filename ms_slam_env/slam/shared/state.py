"""Objects that go on bit-exactly from a state that they gave."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any, ClassVar

from ms_slam_env.errors import InputError


class Stateful(ABC):
    """What can be saved and restored."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays and plain values."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` of an object made in the same way returned."""

    def state_like(self) -> Any:
        """What ``state_check`` compares states with; the object is as it was made, or reset.

        A fresh state, but where that is no example of others.
        """
        return self.get_state()


class Saved(Stateful):
    """An object whose state is the values of the attributes that ``saved`` names.

    Arrays, plain values and lists of them are copied. What is ``Stateful``, or a list of such,
    gives its own state and takes it back. ``also_saved`` names what a subclass adds to the state by
    itself.
    """

    saved: ClassVar[tuple[str, ...]] = ()
    also_saved: ClassVar[tuple[str, ...]] = ()

    def get_state(self) -> dict[str, Any]:
        """Copies of the attributes, by their names without a leading underscore."""
        return {_key(name): _state_of(getattr(self, name)) for name in self.saved}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return {_key(name): _like_of(getattr(self, name)) for name in self.saved}

    def set_state(self, state: dict[str, Any]) -> None:
        """Take the attributes from a state.

        Raises:
            InputError: the state lacks some, as that of something else does; nothing has changed.
        """
        check_has(state, (*map(_key, self.saved), *self.also_saved), type(self).__name__)
        for name in self.saved:
            setattr(self, name, _restored(getattr(self, name), state[_key(name)]))


def check_has(state: Any, names: Iterable[str], kind: str) -> None:
    """Refuse as a state of a ``kind`` what lacks one of ``names``.

    Raises:
        InputError: naming the kind and what is missing.
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
