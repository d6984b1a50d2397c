"""Store finished work items on disk, one JSON line each, safe against interruption at any time."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar

import numpy as np

from ms_slam_env._runtime.input_files import is_named, read_bytes
from ms_slam_env._runtime.output_files import append_line, write_text
from ms_slam_env.errors import InputError, InputWarning

Row = dict[str, Any]
T = TypeVar("T")

_MAX_BYTES = 2**30
_LINE = 100  # longest JSON, in characters, that stays on one line
_INFINITE = {math.inf: "Infinity", -math.inf: "-Infinity"}
_FROM_TEXT = {text: number for number, text in _INFINITE.items()}


def spec_key(spec: Any) -> str:
    """Key of a work item: a hash of the type and every field of dataclass ``spec``.

    Specs that differ in any field have different keys, so a changed configuration never reuses the
    results of another.
    """
    content = {"type": type(spec).__name__, **dataclasses.asdict(spec)}
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class RecordFile:
    """Append-only file of JSON lines, each with a ``key``; the last line with a key counts.

    When ``append`` returns, the complete line is on disk. A line cut short by a kill is ignored,
    and the next ``append`` removes it.

    Args:
        path: the file; the first ``append`` creates it and its folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> dict[str, Row]:
        """Rows by key, in the order of their first appearance.

        Raises:
            InputError: not a regular file, larger than 1 GiB, or with other content.
        """
        if not is_named(self.path):
            return {}
        data = read_bytes(self.path, "results", _MAX_BYTES)
        complete, _, cut_short = data.rpartition(b"\n")
        if cut_short:
            warnings.warn(
                f"{self.path}: the last line was cut short and is dropped",
                InputWarning,
                stacklevel=2,
            )
        rows: dict[str, Row] = {}
        for number, line in enumerate(complete.split(b"\n") if complete else [], start=1):
            try:
                row = from_plain(json.loads(line))
                rows[row["key"]] = row
            except (ValueError, TypeError, KeyError, RecursionError) as error:
                raise InputError(f"{self.path}, line {number}, is not a result") from error
        return rows

    def append(self, row: Row) -> None:
        """Add one row with `output_files.append_line`."""
        append_line(self.path, json.dumps(to_plain(row), allow_nan=False).encode() + b"\n")


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` atomically; :func:`to_plain` converts values that JSON lacks."""
    write_text(path, to_text(to_plain(content)) + "\n")


def to_text(content: Any, margin: str = "\n") -> str:
    """JSON text of plain ``content``; short or flat parts stay on one line."""
    line = json.dumps(content, allow_nan=False)
    inner = content.values() if isinstance(content, dict) else content
    if len(line) <= _LINE or not any(value and isinstance(value, (dict, list)) for value in inner):
        return line
    names = [f"{json.dumps(str(key))}: " for key in content] if isinstance(content, dict) else []
    texts = [to_text(value, margin + " ") for value in inner]
    parts = [name + text for name, text in zip(names or [""] * len(texts), texts, strict=True)]
    return line[0] + margin + " " + f",{margin} ".join(parts) + margin + line[-1]


def to_plain(content: Any) -> Any:
    """``content`` in JSON types: NaN (unknown) becomes null, infinity (never) a text.

    Paths become texts, dataclasses mappings.
    """
    if isinstance(content, dict):
        return {key: to_plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [to_plain(value) for value in content]
    if isinstance(content, np.generic):
        return to_plain(content.item())
    if isinstance(content, Path):
        return str(content)
    if dataclasses.is_dataclass(content) and not isinstance(content, type):
        return to_plain(dataclasses.asdict(content))
    if isinstance(content, float) and not math.isfinite(content):
        return None if math.isnan(content) else _INFINITE[content]
    return content


def from_plain(content: Any) -> Any:
    """Reverse :func:`to_plain`, except that NaN stays None."""
    if isinstance(content, dict):
        return {key: from_plain(value) for key, value in content.items()}
    if isinstance(content, list):
        return [from_plain(value) for value in content]
    return _FROM_TEXT.get(content, content) if isinstance(content, str) else content


_PLAIN: Mapping[str, tuple[type, ...]] = {
    "str": (str,),
    "bool": (bool,),
    "int": (int,),
    "float": (int, float),
    "dict[str, Any]": (dict,),
    "Sequence[Point]": (str, int, float, NoneType),
    "Sequence[float | None]": (int, float, NoneType),
    "Sequence[int]": (int,),
    "Sequence[str]": (str,),
}  # annotation to the JSON types allowed there


def build(cls: type[T], values: Mapping[str, Any]) -> T:
    """Build dataclass ``cls`` from untrusted JSON.

    Raises:
        TypeError: a missing or unknown field, or a value of the wrong type.
        OverflowError: an integer too large for a float.
    """
    made = cls(**values)
    for field in dataclasses.fields(made):  # type: ignore[arg-type]
        value = getattr(made, field.name)
        of_many = str(field.type).startswith("Sequence")
        if of_many and not isinstance(value, (list, tuple)):
            raise TypeError(f"{field.name} is not a list")
        kinds = _PLAIN.get(str(field.type))
        if kinds is not None:
            for part in value if of_many else (value,):
                check_plain(field.name, part, kinds)
    return made


def check_plain(
    name: str, value: Any, kinds: tuple[type, ...] = (str, int, float, NoneType)
) -> None:
    """Refuse a JSON value of another type than ``kinds``.

    Raises:
        TypeError: a type not in ``kinds``.
        OverflowError: an integer too large for a float.
    """
    if not isinstance(value, kinds):
        raise TypeError(f"{name} is {type(value).__name__}")
    if isinstance(value, int):
        float(value)
