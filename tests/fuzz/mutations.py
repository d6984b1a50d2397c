"""Mutations of valid inputs: bytes, texts, nested values and folders of files."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
Files = Mapping[str, "bytes | Special"]

NUMBERS = (
    *("nan", "inf", "-inf", "1e309", "-1", "0", "1e-320", "1e300", "0.5", "1" * 400),
    *("9223372036854775808", "x", "", "0x10", "1" * 5000, "1_0", "٣", "--", "1e9", "-0.0"),
)
"""Words in the place of a number."""

PLAIN: tuple[Any, ...] = (
    *(None, True, -1, 0, 0.5, 7, 2**31, 2**63, 10**400, 1e308, math.nan, math.inf, -math.inf),
    *("", "x", "nan", "a\nb", "$x^{", "\ud800", "../../x", "<b>&'\"", "9" * 5000, "\0"),
    *([], {}, [[]], [None], {"x": {"y": 1}}, [1, [2, 3]], "x" * 10_000),
)
"""Values in the place of another, of JSON's types."""

ARRAYS: tuple[Callable[[Any], Any], ...] = (
    lambda value: np.full_like(value, np.nan) if _is_float(value) else ~np.zeros_like(value),
    lambda value: np.full_like(value, np.inf) if _is_float(value) else np.zeros_like(value),
    lambda value: value[:0] if value.ndim else value[None],
    lambda value: np.concatenate([value, value]) if value.ndim else value + 1,
    lambda value: value.T if value.ndim > 1 else value[..., None],
    lambda value: value.astype(np.float64 if value.dtype != np.float64 else np.int64),
    lambda value: value.astype(object),
    lambda value: value * 3 if value.dtype.kind in "fiu" else value,
    lambda value: value.ravel(),
)
"""What becomes of an array."""


@dataclasses.dataclass(frozen=True)
class Special:
    """No regular file of its own: ``fifo``, ``folder``; ``link``, ``hardlink`` with its target."""

    kind: str
    target: str = ""


def mutated_bytes(data: bytes, rng: Rng) -> bytes:
    """Flip, cut, insert, repeat or move some bytes, up to four times."""
    for _ in range(rng.integers(1, 5)):
        at, end = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
        end = min(end, at + int(rng.choice([1, 4, 64, len(data)])))
        some = rng.integers(0, 256, rng.integers(1, 9), dtype=np.uint8).tobytes()
        flipped = bytes(b ^ (1 << int(rng.integers(8))) for b in data[at : at + 1])
        other = int(rng.integers(0, len(data) + 1))
        data = (
            data[:at] + flipped + data[at + 1 :],
            data[:at] + data[end:],
            data[:at],
            data[:at] + some + data[at:],
            data[:at] + some + data[at + len(some) :],
            data[:at] + b"\xff" * (end - at) + data[end:],
            data[:other] + data[at:end] + data[other:],
        )[rng.integers(7)]
    return data


def mutated_text(data: bytes, rng: Rng) -> bytes:
    """Replace words that look like numbers, drop, repeat or swap lines; or as any bytes."""
    text = data.decode("utf-8", errors="replace")
    lines = text.split("\n")
    a, b = (int(k) for k in rng.integers(0, len(lines), 2))
    words = list(re.finditer(r"[-+.\w]+", text))
    match rng.integers(5):
        case 0 | 1 if words:
            word = words[rng.integers(len(words))]
            new = NUMBERS[rng.integers(len(NUMBERS))]
            return (text[: word.start()] + new + text[word.end() :]).encode()
        case 2:
            return "\n".join(lines[:a] + lines[a + 1 :]).encode()
        case 3:
            return "\n".join([*lines[:a], lines[b], *lines[a:]]).encode()
    return mutated_bytes(data, rng)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of everything in nested mappings, lists, tuples and objects with fields."""
    yield path
    for key in _keys(value):
        yield from places(child(value, key), (*path, key))


def mutated_tree(value: Any, rng: Rng, plain: Sequence[Any] = PLAIN) -> Any:
    """A copy with one to three places removed, added, or given another value."""
    for _ in range(rng.integers(1, 4)):
        every = list(places(value))
        depth = rng.integers(1, max([1, *map(len, every)]) + 1)  # large tables do not take it all
        path = _pick([p for p in every if len(p) == depth] or every, rng)
        value = _with(value, path, rng, plain)
    return value


def _with(value: Any, path: tuple[Any, ...], rng: Rng, plain: Sequence[Any]) -> Any:
    if not path:
        return _other(value, rng, plain)
    value = copy.copy(value) if not isinstance(value, tuple) else list(value)
    key, *rest = path
    if rest:
        _set(value, key, _with(child(value, key), tuple(rest), rng, plain))
    elif rng.random() < 0.2 and isinstance(value, (dict, list)):
        del value[key]
    elif rng.random() < 0.1 and isinstance(value, dict):
        value[_pick(["x", 7, None, "\ud800", *value], rng)] = _pick(plain, rng)
    else:
        _set(value, key, _other(child(value, key), rng, plain))
    return value


def _other(value: Any, rng: Rng, plain: Sequence[Any]) -> Any:
    """Something in the place of ``value``, often like it."""
    if isinstance(value, np.ndarray) and value.dtype.names is None and rng.random() < 0.8:
        return _pick(ARRAYS, rng)(value)
    if isinstance(value, list) and value and rng.random() < 0.5:
        return _pick([value * 2, value[::-1], value[:1] * 1000, value[0], [value]], rng)
    if (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and rng.random() < 0.4
        and abs(value) < 1e300
    ):
        return _pick([-value, value * 1e6, value + 1, str(value), [value], float(value)], rng)
    if isinstance(value, str) and rng.random() < 0.3:
        return _pick([value + "x", value * 3, value.upper(), value[:1], f" {value}"], rng)
    return copy.deepcopy(_pick(plain, rng))


def mutated_json(data: bytes, rng: Rng) -> bytes:
    """The nested values of a JSON text, or its bytes; these alone where it is broken already."""
    if rng.random() < 0.2:
        return mutated_text(data, rng)
    try:
        tree = json.loads(data)
    except ValueError:
        return mutated_text(data, rng)
    return json.dumps(mutated_tree(tree, rng), default=repr).encode()


def mutated_folder(files: Files, rng: Rng) -> Files:
    """One to three files changed, taken away, renamed, or replaced by what is no file."""
    made = dict(files)
    for _ in range(rng.integers(1, 4)):
        if not made:
            break
        name = sorted(made)[rng.integers(len(made))]
        content = made[name]
        draw = rng.random()
        if draw < 0.1:
            del made[name]
        elif draw < 0.2:
            made[name] = SPECIAL[rng.integers(len(SPECIAL))]
        elif draw < 0.25:
            made[f"{name}{_pick(['$x', '|', ' ', '.png', '~', '7'], rng)}"] = made.pop(name)
        elif draw < 0.3:
            made[name] = made[sorted(made)[rng.integers(len(made))]]
        elif isinstance(content, bytes):
            made[name] = mutated_file(name, content, rng)
    return made


SPECIAL = (
    *(Special("fifo"), Special("folder"), Special("link", "/dev/zero")),
    *(Special("link", "/nowhere/at/all"), Special("link", ".")),
)


def mutated_file(name: str, data: bytes, rng: Rng) -> bytes:
    """By the ending of the name."""
    suffix = name.rpartition(".")[2]
    if suffix in ("json", "gltf"):
        return mutated_json(data, rng)
    head, end, body = data.partition(b"end_header")
    if suffix == "ply" and end and rng.random() < 0.5:
        return mutated_text(head, rng) + end + body
    if data.startswith(b"glTF") and rng.random() < 0.7:
        size = int.from_bytes(data[12:16], "little")
        text = mutated_json(data[20 : 20 + size], rng)
        return data[:12] + len(text).to_bytes(4, "little") + b"JSON" + text + data[20 + size :]
    is_text = suffix in ("txt", "csv", "yaml", "obj", "mtl", "off", "xml")
    return mutated_text(data, rng) if is_text else mutated_bytes(data, rng)


def write_files(files: Files, folder: Path) -> None:
    """Write them into a folder; names that cannot be are left out."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content.kind == "fifo":
            os.mkfifo(path)
        elif content.kind == "folder":
            path.mkdir()
        elif content.kind == "hardlink":
            os.link(path.parent / content.target, path)
        else:
            path.symlink_to(content.target)


def _pick(choices: Sequence[Any], rng: Rng) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _is_float(value: Any) -> bool:
    return bool(value.dtype.kind == "f")


def _keys(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value)
    if isinstance(value, (list, tuple)):
        return list(range(min(len(value), 3)))
    return list(vars(value)) if dataclasses.is_dataclass(value) else []


def child(value: Any, key: Any) -> Any:
    """What stands at ``key``: of a mapping, a list, or an object's fields."""
    return value[key] if isinstance(value, (dict, list, tuple)) else getattr(value, key)


def _set(owner: Any, key: Any, value: Any) -> None:
    if isinstance(owner, (dict, list)):
        owner[key] = value
    else:
        object.__setattr__(owner, key, value)
