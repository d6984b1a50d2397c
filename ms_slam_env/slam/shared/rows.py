"""Dataclasses of arrays with one row per item."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

R = TypeVar("R", bound="Rows")


class Rows:
    """A dataclass of arrays (N, ...); a scalar field applies to all rows."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def chosen(self: R, which: Any) -> R:
        """Select rows by indices, a mask or a slice."""
        values = [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]
        return type(self)(*(v[which] if isinstance(v, np.ndarray) else v for v in values))


def join(parts: Sequence[R]) -> R:
    """Concatenate the rows of several; all fields must be arrays."""
    kind = type(parts[0])
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    return kind(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
