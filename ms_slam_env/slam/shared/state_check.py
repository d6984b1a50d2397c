"""Validates a saved state before it is restored: content, types, shapes and sizes.

A state is compared with the template of ``Stateful.state_like``: a fresh state in which `ArrayOf`,
`ListOf`, `WholeNumber`, `OrNone` and `Fields` replace values that vary, and relate lengths to
indices.
"""

from __future__ import annotations

import numbers
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError

_IDENTITY = np.eye(3)
_RIGID = 1e-4  # as in ``check_pose``
_KINDS: tuple[Any, ...] = ((bool, np.bool_), numbers.Integral, (float, np.floating), str, tuple)
_SUM_ERROR = 1e-6  # tolerance of a distribution's sum
MOST = 2**30
"""Largest count in a state, so that no later count overflows 32 bits."""
_MOST_FLOAT32 = 1e15  # kernels square them and add them up
_MOST_SEED = 2**31 - 1


@dataclass(frozen=True)
class WholeNumber:
    """A whole number in a state.

    Attributes:
        least: smallest.
        most: largest, or the name of a length that is.
        index_of: name of a length that it must be below; 0 is valid even if that length is 0.
    """

    least: int = 0
    most: int | str = MOST
    index_of: str = ""


SEED = WholeNumber(most=_MOST_SEED)
"""Seed of noise or of a scene."""


@dataclass(frozen=True)
class Real:
    """A number in a state between ``least`` and ``most``, which may be infinite."""

    least: float = -np.inf
    most: float = np.inf


@dataclass(frozen=True)
class ArrayOf:
    """An array in a state.

    Attributes:
        dtype: type of its elements.
        shape: lengths of its axes. A name stands for the same length throughout the state, or
            within one element of a list.
        least: smallest element; None: any finite value.
        most: largest element; used only with ``least``.
        index_of: name of a length that all elements must be below.
        may_be_nan: whether NaN is allowed and means "none".
        is_distribution: whether it sums to 1 along the last axis.
    """

    dtype: Any
    shape: tuple[int | str, ...]
    least: float | None = None
    most: float = np.inf
    index_of: str = ""
    may_be_nan: bool = False
    is_distribution: bool = False


@dataclass(frozen=True)
class ListOf:
    """A list in a state whose elements match one template.

    Attributes:
        of: template of the elements.
        length: name of its length, or its largest length.
        rising: key of a whole number in each mapping that must increase along the list.
    """

    of: Any
    length: int | str = MOST
    rising: str = ""


@dataclass(frozen=True)
class OrNone:
    """None, or a value that matches ``of``."""

    of: Any


@dataclass(frozen=True)
class Fields:
    """A mapping in a state with an additional rule, which returns what is wrong or ""."""

    of: Mapping[str, Any]
    rule: Callable[[Any], str]


@dataclass(frozen=True)
class Depending:
    """A template that ``of`` computes from the value to be checked."""

    of: Callable[[Any], Any]


@dataclass
class _Lengths:
    """Named lengths, and checks to run once all are known."""

    outer: _Lengths | None = None
    own: dict[str, int] = field(default_factory=dict)
    later: list[Callable[[], None]] = field(default_factory=list)

    def inside(self) -> _Lengths:
        """Open a scope for one element of a list."""
        return _Lengths(self, later=self.later)

    def fix(self, length: int | str, found: int, where: str) -> None:
        """Refuse a length that differs from the named one or from the given number."""
        wanted = self.own.setdefault(length, found) if isinstance(length, str) else length
        if found != wanted:
            raise wrong(where, f"has length {found} in place of {wanted}")

    def get(self, name: str) -> int | None:
        """The named length, or None if it is not known."""
        if name in self.own:
            return self.own[name]
        return self.outer.get(name) if self.outer else None

    def most(self, like: WholeNumber | ArrayOf) -> float:
        """The largest value that ``like`` allows."""
        if like.index_of:
            count = self.get(like.index_of)
            least = 0 if isinstance(like, WholeNumber) else -1
            return MOST if count is None else max(count - 1, least)
        if isinstance(like, ArrayOf):
            return min(like.most, MOST) if np.dtype(like.dtype).kind in "iu" else like.most
        most = self.get(like.most) if isinstance(like.most, str) else like.most
        return MOST if most is None else most


def check_like(value: Any, like: Any, where: str, lengths: Mapping[str, int] | None = None) -> None:
    """Refuse a part of a state that does not match the template ``like``.

    Where ``like`` is an empty table, an empty list or None, ``value`` may hold more; where an array
    in ``like`` holds NaN, meaning "none", so may ``value``. Counts must not be negative, numbers
    must be finite, and poses must be rigid motions. ``lengths`` are the named lengths known in
    advance.

    Raises:
        InputError: it names the place in the state and what is wrong with it.
    """
    known = _Lengths(own=dict(lengths or {}))
    _check(value, like, where, known)
    for check in known.later:
        check()


def _check(value: Any, like: Any, where: str, lengths: _Lengths) -> None:
    if isinstance(like, np.ndarray):
        check_array(value, like, where)
        if like.dtype.kind == "i" and like.size and like.min() >= 0:
            _check_between(value, 0, MOST, where)
    elif isinstance(like, ArrayOf):
        _check_array_of(value, like, where, lengths)
    elif isinstance(like, WholeNumber):
        check_plain(value, 0, where, low=like.least)
        lengths.later.append(lambda: _check_between(value, like.least, lengths.most(like), where))
    elif isinstance(like, numbers.Integral) and not isinstance(like, bool):
        least = min(0, int(like))  # -1 in the template allows -1 for none
        _check(value, WholeNumber(least), where, lengths)
    elif isinstance(like, Real):
        if not isinstance(value, (float, np.floating)) or not like.least <= value <= like.most:
            raise wrong(where, f"is {value!r}, no number in [{like.least:g}, {like.most:g}]")
    elif isinstance(like, Fields):
        _check(value, like.of, where, lengths)
        lengths.later.append(lambda: _check_rule(value, like.rule, where))
    elif isinstance(like, Depending):
        _check(value, like.of(value), where, lengths)
    elif isinstance(like, OrNone):
        if value is not None:
            _check(value, like.of, where, lengths)
    elif isinstance(like, ListOf):
        _check_list_of(value, like, where, lengths)
    elif isinstance(like, Mapping):
        _check_fields(value, like, where, lengths)
    elif isinstance(like, (list, tuple)) and like:
        check_list(value, where, len(like), type(like))
        for k, pair in enumerate(zip(value, like, strict=True)):
            _check(*pair, f"{where}[{k}]", lengths.inside())
    elif like is None or isinstance(like, list):
        _check_free(value, where)
    else:
        check_plain(value, like, where)


def _check_between(value: Any, least: float, most: float, where: str) -> None:
    if isinstance(value, np.ndarray):
        if not value.size:
            return
        low, high = value.min(), value.max()
    else:
        low = high = value
    if low < least or high > most:
        raise wrong(where, f"counts to {low if low < least else high}, outside [{least}, {most}]")


def _check_rule(value: Any, rule: Callable[[Any], str], where: str) -> None:
    what = rule(value)
    if what:
        raise wrong(where, what)


def _check_array_of(value: Any, like: ArrayOf, where: str, lengths: _Lengths) -> None:
    _check_form(value, like.dtype, len(like.shape), where)
    for length, found in zip(like.shape, value.shape, strict=True):
        lengths.fix(length, found, where)
    check_values(value, where, like.may_be_nan)
    if like.is_distribution and (np.abs(value.sum(axis=-1) - 1) > _SUM_ERROR).any():
        raise wrong(where, "are no distributions")
    least = like.least
    if least is not None:
        lengths.later.append(lambda: _check_between(value, least, lengths.most(like), where))


def _check_list_of(value: Any, like: ListOf, where: str, lengths: _Lengths) -> None:
    check_list(value, where)
    if isinstance(like.length, str):
        lengths.fix(like.length, len(value), where)
    elif len(value) > like.length:
        raise wrong(where, f"has {len(value)} elements, more than {like.length}")
    if like.rising:  # before anything that takes time
        _check_rising(value, like.rising, where)
    if isinstance(like.of, np.ndarray):
        if value:
            check_array(stacked(value, where), np.zeros((0, *like.of.shape), like.of.dtype), where)
        return
    is_flat = isinstance(like.of, ArrayOf)  # arrays of one shape
    for k, one in enumerate(value):
        _check(one, like.of, f"{where}[{k}]", lengths if is_flat else lengths.inside())


def _check_rising(value: list[Any], key: str, where: str) -> None:
    last = -1
    for one in value:
        now = one.get(key) if isinstance(one, Mapping) else None
        if not isinstance(now, numbers.Integral) or int(now) <= last:
            raise wrong(where, f"is not in the order of {key}")
        last = int(now)


def is_open(like: Any) -> bool:
    """Whether ``like`` has parts whose content ``check_like`` cannot know."""
    if isinstance(like, (Fields, OrNone, ListOf)):
        return is_open(like.of)
    if isinstance(like, Mapping):
        return any(map(is_open, like.values()))
    if isinstance(like, list):
        return not like or any(map(is_open, like))
    return like is None


def wrong(where: str, what: str) -> InputError:
    """Make the error for a place in a state."""
    return InputError(f"not a saved state: {where} {what}")


def check_mapping(value: Any, where: str) -> None:
    """Refuse anything but a mapping."""
    if not isinstance(value, Mapping):
        raise wrong(where, f"is a {type(value).__name__}, not a mapping")


def check_keys(value: Mapping[Any, Any], names: Sequence[str], where: str) -> None:
    """Refuse a mapping whose keys are not ``names``."""
    if set(value) != set(names):
        missing = [name for name in names if name not in value]
        more = sorted(str(name) for name in set(value) - set(names))
        raise wrong(where, f"lacks {missing}" if missing else f"has {more} too")


def check_list(
    value: Any, where: str, length: int | None = None, kind: type[Sequence[Any]] = list
) -> None:
    """Refuse anything but a list, of that ``length`` if given."""
    if not isinstance(value, kind):
        raise wrong(where, f"is a {type(value).__name__}, not a {kind.__name__}")
    if length is not None and len(value) != length:
        raise wrong(where, f"has {len(value)} elements in place of {length}")


def _check_fields(value: Any, like: Mapping[str, Any], where: str, lengths: _Lengths) -> None:
    check_mapping(value, where)
    check_keys(value, list(like), where)
    if "bit_generator" in like:
        _check_random(value, like, where)
        return
    for name, own in like.items():
        _check(value[name], own, f"{where}.{name}", lengths)


def _check_random(value: Mapping[str, Any], like: Mapping[str, Any], where: str) -> None:
    """Refuse a random generator's state that a generator of its kind does not accept."""
    generator = getattr(np.random, str(like["bit_generator"]))(0)
    try:
        generator.state = value
        is_taken = _is_same(generator.state, value)
    except (TypeError, ValueError, KeyError, OverflowError):
        is_taken = False
    if not is_taken:
        raise wrong(where, f"is not a state of {like['bit_generator']}")


def _is_same(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping):
        return isinstance(b, Mapping) and all(_is_same(a[name], b[name]) for name in a)
    return type(a) is type(b) and a == b


def check_array(value: Any, like: NDArray[Any], where: str) -> None:
    """Refuse anything but an array of the same type and shape; an empty first axis may grow."""
    _check_form(value, like.dtype, like.ndim, where)
    grows = like.ndim > 0 and len(like) == 0
    rest = slice(int(grows), None)
    if value.shape[rest] != like.shape[rest]:
        raise wrong(where, f"has shape {value.shape} in place of {like.shape}")
    may_be_nan = like.dtype.kind == "f" and not grows and bool(np.isnan(like).any())
    check_values(value, where, may_be_nan)


def _check_form(value: Any, dtype: Any, ndim: int, where: str) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != dtype:
        found = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise wrong(where, f"is of {found}, not an array of {np.dtype(dtype)}")
    if value.ndim != ndim:
        raise wrong(where, f"has shape {value.shape}, not {ndim} axes")


def stacked(arrays: list[Any], where: str) -> NDArray[Any]:
    """Stack arrays of one shape and type.

    Raises:
        InputError: they differ in shape or type; the message names the place in the state.
    """
    if not all(isinstance(array, np.ndarray) for array in arrays):
        raise wrong(where, "holds something else than arrays")
    if len({(array.shape, array.dtype) for array in arrays}) > 1:
        raise wrong(where, "holds arrays of several shapes or types")
    return np.array(arrays)


def check_values(value: NDArray[Any], where: str, may_be_nan: bool = False) -> None:
    """Refuse numbers that are not finite, and arrays (..., 4, 4) that are not rigid motions.

    Raises:
        InputError: it names the place in the state.
    """
    if value.dtype.names:
        for name in value.dtype.names:
            check_values(value[name], f"{where}.{name}")
    if value.dtype.kind == "O":
        raise wrong(where, "is an array of objects")
    if value.dtype.kind != "f":
        return
    if value.shape[-2:] == (4, 4):
        stack = value.reshape(-1, 4, 4)
        _check_rigid(stack[~np.isnan(stack).all(axis=(1, 2))] if may_be_nan else stack, where)
    elif not _is_finite(value) and not (may_be_nan and not np.isinf(value).any()):
        raise wrong(where, "holds a value that is not finite")


def _is_finite(value: NDArray[Any]) -> bool:
    flat = value.reshape(-1)
    # The sum of squares takes a fifth of the time; it is finite unless a value is not or is huge.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(np.dot(flat, flat)):
            return True
    return bool((np.abs(flat) < (_MOST_FLOAT32 if flat.dtype == np.float32 else np.inf)).all())


def _check_rigid(stack: NDArray[Any], where: str) -> None:
    R = stack[:, :3, :3]
    is_rigid = (
        _is_finite(stack)
        and (np.abs(R @ R.swapaxes(1, 2) - _IDENTITY) < _RIGID).all()
        and (np.linalg.det(R) > 0).all()
        and (stack[:, 3] == (0, 0, 0, 1)).all()
    )
    if not is_rigid:
        raise wrong(where, "holds a pose that is no rigid motion")


def check_plain(value: Any, like: Any, where: str, low: int | None = None) -> None:
    """Refuse a value of another kind than ``like``, a negative count, a number not finite."""
    kind = next(kind for kind in _KINDS if isinstance(like, kind))
    if not isinstance(value, kind) or (kind is not _KINDS[0] and isinstance(value, _KINDS[0])):
        raise wrong(where, f"is a {type(value).__name__}, not a {type(like).__name__}")
    if kind is numbers.Integral:
        low = min(0, like) if low is None else low  # -1 in the template allows -1 for none
        if not low <= value <= _MOST_SEED:
            raise wrong(where, f"is {value}, outside [{low}, {_MOST_SEED}]")
    if kind is _KINDS[2] and not np.isfinite(value):
        raise wrong(where, f"is {value}, not finite")


def _check_free(value: Any, where: str) -> None:
    """Check a part whose template is empty: plain values and arrays of numbers only."""
    if isinstance(value, np.ndarray):
        check_values(value, where)
    elif isinstance(value, Mapping):
        for name, one in value.items():
            _check_free(one, f"{where}.{name}")
    elif isinstance(value, (list, tuple)):
        for k, one in enumerate(value):
            _check_free(one, f"{where}[{k}]")
    elif value is not None and not isinstance(value, (bool, int, float, str, np.generic)):
        raise wrong(where, f"is a {type(value).__name__}")
    elif isinstance(value, (float, np.floating)) and not np.isfinite(value):
        raise wrong(where, f"is {value}, not finite")
