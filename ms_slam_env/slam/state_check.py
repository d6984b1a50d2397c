"""Whether a state may be gone on from: what it holds, of which type, shape and size.

There is no second description of what each part keeps: a part is compared with one that the same
object made itself, whose arrays and tables are the smallest that there are.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError

_TABLES = (  # arrays with a row for each of the same things
    ("position", "normal", "color", "radius", "confidence", "created", "seen"),
    ("bits", "known", "poses", "times"),
    ("dropped", "offsets"),
)
_IDENTITY = np.eye(3)
_RIGID = 1e-4  # as ``check_pose`` has it
_KINDS: tuple[Any, ...] = ((bool, np.bool_), numbers.Integral, (float, np.floating), str, tuple)
_MOST = 2**31  # counts and seeds of noise are below


def check_like(value: Any, like: Any, where: str) -> None:
    """Refuse a part of a state that is not made like a part of the same environment.

    Where ``like`` is an empty table, list or None there may be more of it; where an array of it
    holds NaN, meaning none, ``value`` may as well. Counts are not negative, numbers are finite,
    poses are rigid motions.

    Raises:
        InputError: naming the place in the state and what is wrong with it.
    """
    if isinstance(like, np.ndarray):
        check_array(value, like, where)
        is_count = like.dtype.kind == "i" and like.size and like.min() >= 0
        if is_count and (value < 0).any():
            raise wrong(where, f"counts to {value.min()}")
    elif isinstance(like, Mapping):
        _check_fields(value, like, where)
    elif isinstance(like, list) and like:
        check_list(value, where, len(like))
        for k, pair in enumerate(zip(value, like, strict=True)):
            check_like(*pair, f"{where}[{k}]")
    elif like is None or isinstance(like, list):
        _check_free(value, where)
    else:
        check_plain(value, like, where)


def is_open(like: Any) -> bool:
    """Whether something in ``like`` may be replaced by what ``check_like`` knows nothing of."""
    if isinstance(like, Mapping):
        return any(map(is_open, like.values()))
    if isinstance(like, list):
        return not like or any(map(is_open, like))
    return like is None


def wrong(where: str, what: str) -> InputError:
    """Return the error that says what is wrong at a place in a state."""
    return InputError(f"this is no state to go on from: {where} {what}")


def check_mapping(value: Any, where: str) -> None:
    """Refuse what is no mapping."""
    if not isinstance(value, Mapping):
        raise wrong(where, f"is a {type(value).__name__}, not a mapping")


def check_keys(value: Mapping[Any, Any], names: Sequence[str], where: str) -> None:
    """Refuse a mapping of other keys than ``names``."""
    if set(value) != set(names):
        missing = [name for name in names if name not in value]
        more = sorted(str(name) for name in set(value) - set(names))
        raise wrong(where, f"lacks {missing}" if missing else f"has {more} too")


def check_list(value: Any, where: str, length: int | None = None) -> None:
    """Refuse what is no list, or not of that length."""
    if not isinstance(value, list):
        raise wrong(where, f"is a {type(value).__name__}, not a list")
    if length is not None and len(value) != length:
        raise wrong(where, f"has {len(value)} elements in place of {length}")


def _check_fields(value: Any, like: Mapping[str, Any], where: str) -> None:
    check_mapping(value, where)
    check_keys(value, list(like), where)
    if "bit_generator" in like:
        _check_random(value, like, where)
        return
    for name, own in like.items():
        check_like(value[name], own, f"{where}.{name}")
    for table in _TABLES:
        rows = {len(value[name]) for name in table if name in value}
        if len(rows) > 1 and all(name in value for name in table):
            raise wrong(where, f"has tables of {sorted(rows)} rows")
    if {"counters", "surfels"} <= set(like):
        _check_counts(value, where)


def _check_counts(value: Mapping[str, Any], where: str) -> None:
    """The counters of surfel maps say how many surfels there are."""
    used = np.array([len(arrays["radius"]) for arrays in value["surfels"]])
    counters = value["counters"]
    if (counters["count"] != used).any() or (counters["dead"] > used).any():
        raise wrong(f"{where}.counters", f"do not count the {used.tolist()} surfels")


def _check_random(value: Mapping[str, Any], like: Mapping[str, Any], where: str) -> None:
    """The state of a random number generator is one that a generator of its kind takes."""
    generator = getattr(np.random, str(like["bit_generator"]))(0)
    try:
        generator.state = value
        is_taken = _is_same(generator.state, value)
    except (TypeError, ValueError, KeyError, OverflowError):
        is_taken = False
    if not is_taken:
        raise wrong(where, f"is no state of {like['bit_generator']}")


def _is_same(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping):
        return isinstance(b, Mapping) and all(_is_same(a[name], b[name]) for name in a)
    return type(a) is type(b) and a == b


def check_array(value: Any, like: NDArray[Any], where: str) -> None:
    """Refuse what is no array of the same type and shape; the first axis may grow from nothing."""
    if not isinstance(value, np.ndarray) or value.dtype != like.dtype:
        found = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise wrong(where, f"is of {found}, not an array of {like.dtype}")
    grows = like.ndim > 0 and len(like) == 0
    rest = slice(int(grows), None)
    if value.ndim != like.ndim or value.shape[rest] != like.shape[rest]:
        raise wrong(where, f"has shape {value.shape} in place of {like.shape}")
    may_be_nan = like.dtype.kind == "f" and not grows and bool(np.isnan(like).any())
    check_values(value, where, may_be_nan)


def check_values(value: NDArray[Any], where: str, may_be_nan: bool = False) -> None:
    """Refuse numbers that are not finite, and (..., 4, 4) that are no rigid motions.

    Raises:
        InputError: naming the place in the state.
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
    # The sum of squares, a fifth of the time, is finite unless a value is not, or very large.
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(np.dot(flat, flat)) or np.isfinite(flat).all())


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


def check_plain(value: Any, like: Any, where: str) -> None:
    """Refuse a value of another kind than ``like``, a negative count, a number not finite."""
    kind = next(kind for kind in _KINDS if isinstance(like, kind))
    if not isinstance(value, kind) or (kind is not _KINDS[0] and isinstance(value, _KINDS[0])):
        raise wrong(where, f"is a {type(value).__name__}, not a {type(like).__name__}")
    low = min(0, like) if kind is numbers.Integral else 0  # where there may be none, -1 says so
    if kind is numbers.Integral and not low <= value < _MOST:
        raise wrong(where, f"is {value}, outside [{low}, {_MOST})")
    if kind is _KINDS[2] and not np.isfinite(value):
        raise wrong(where, f"is {value}, not finite")


def _check_free(value: Any, where: str) -> None:
    """What a part that is still empty has no example of: plain values and arrays of numbers."""
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
