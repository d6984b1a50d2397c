"""Finished pieces of work on disk: one JSON line each, safe against interruption at any time."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.errors import InputError

Row = dict[str, Any]

_INFINITE = {math.inf: "Infinity", -math.inf: "-Infinity"}
_FROM_TEXT = {text: number for number, text in _INFINITE.items()}


def spec_key(spec: Any) -> str:
    """Name of a piece of work: a hash of the type and every field of dataclass ``spec``.

    Two specs that differ in any field have different keys, so a changed configuration never meets
    the results of another.
    """
    content = {"type": type(spec).__name__, **dataclasses.asdict(spec)}
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class RecordFile:
    """Append-only file of JSON lines, each with a ``key``; the last line of a key counts.

    A line is written by one ``write`` call and synced before ``append`` returns. A line that a kill
    cut short is dropped when the file is next read.

    Args:
        path: of the file; it and its folder are created by the first ``append``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> dict[str, Row]:
        """Rows by key, in the order of their first appearance.

        Raises:
            InputError: the file holds something else.
        """
        if not self.path.exists():
            return {}
        data = self.path.read_bytes()
        complete, _, cut_short = data.rpartition(b"\n")
        if cut_short:
            os.truncate(self.path, len(data) - len(cut_short))
        rows: dict[str, Row] = {}
        for number, line in enumerate(complete.split(b"\n") if complete else [], start=1):
            try:
                row = from_plain(json.loads(line))
                rows[row["key"]] = row
            except (ValueError, TypeError, KeyError) as error:
                raise InputError(f"{self.path}, line {number}, is not a result") from error
        return rows

    def append(self, row: Row) -> None:
        """Add one row; it is on disk when this returns."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps(to_plain(row), allow_nan=False).encode() + b"\n"
        descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(descriptor, line)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_json(path: Path, content: Any) -> None:
    """Write ``content``; an interrupt leaves the old file or the new one, never half of one.

    See :func:`to_plain` for numbers that JSON does not have.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(to_plain(content), indent=1, allow_nan=False) + "\n")
    os.replace(partial, path)


def to_plain(content: Any) -> Any:
    """``content`` in JSON's types: NaN (not known) becomes null, infinity (never) a text."""
    if isinstance(content, dict):
        return {key: to_plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [to_plain(value) for value in content]
    if isinstance(content, np.generic):
        return to_plain(content.item())
    if isinstance(content, float) and not math.isfinite(content):
        return None if math.isnan(content) else _INFINITE[content]
    return content


def from_plain(content: Any) -> Any:
    """What :func:`to_plain` was given, but None where that had NaN."""
    if isinstance(content, dict):
        return {key: from_plain(value) for key, value in content.items()}
    if isinstance(content, list):
        return [from_plain(value) for value in content]
    return _FROM_TEXT.get(content, content) if isinstance(content, str) else content
