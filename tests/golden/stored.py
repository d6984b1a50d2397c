"""The stored values: a part of what the cases give, in small files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cases import Arrays

STORED = Path(__file__).parent / "stored"
ROWS, VALUES = 8, 48  # kept of an array, and of each of its rows


def kept(arrays: Arrays) -> Arrays:
    """Single numbers and numbers by frame or step in full, of larger arrays evenly spread ones.

    Floats become float32: beyond its precision processor types disagree anyway.
    """
    return {name: _single(_thinned(array)) for name, array in arrays.items()}


def _thinned(array: np.ndarray) -> np.ndarray:
    if array.ndim < 2:
        return array
    rows = array[_spread(len(array), ROWS)].reshape(min(len(array), ROWS), -1)
    return rows[:, _spread(rows.shape[1], VALUES)]


def _spread(count: int, most: int) -> np.ndarray:
    """Indices, evenly spread, first and last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def _single(array: np.ndarray) -> np.ndarray:
    return array.astype(np.float32) if array.dtype == np.float64 else array


def write(found: dict[str, Arrays]) -> None:
    """Write one file for each group of cases; those of a group that were not run are kept."""
    STORED.mkdir(exist_ok=True)
    for group in {case.split("/")[0] for case in found}:
        cases = {**read(group), **{k: v for k, v in found.items() if k.split("/")[0] == group}}
        np.savez_compressed(
            STORED / f"{group}.npz",
            **{f"{case}:{name}": a for case, arrays in cases.items() for name, a in arrays.items()},
        )


def read(group: str) -> dict[str, Arrays]:
    """Case -> name -> array of the cases of a group; empty if nothing is stored."""
    path = STORED / f"{group}.npz"
    found: dict[str, Arrays] = {}
    if path.exists():
        with np.load(path) as file:
            for key in file.files:
                case, name = key.split(":")
                found.setdefault(case, {})[name] = file[key]
    return found
