"""The stored values: a part of what the cases give, in small files."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from pathlib import Path

import numpy as np
from cases import Arrays

STORED = Path(__file__).parent / "stored"
ROWS, VALUES = 8, 40  # kept of an array, and of each of its rows


def kept(arrays: Arrays) -> Arrays:
    """Single numbers and numbers by frame or step in full, of larger arrays evenly spread ones.

    Floats become float32: beyond its precision processor types disagree anyway.
    """
    return {name: _single(_thinned(array)) for name, array in arrays.items()}


def _thinned(array: np.ndarray) -> np.ndarray:
    if array.ndim < 2 or not array.size:
        return array
    rows = array[_spread(len(array), ROWS)].reshape(min(len(array), ROWS), -1)
    return rows[:, _spread(rows.shape[1], VALUES)]


def _spread(count: int, most: int) -> np.ndarray:
    """Indices, evenly spread, first and last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def _single(array: np.ndarray) -> np.ndarray:
    return array.astype(np.float32) if array.dtype == np.float64 else array


def write(found: dict[str, Arrays]) -> None:
    """Write one file for each group of cases; those of a group that were not run are kept.

    A file is one array for each type of number, all values in a row, and an index that says how
    they are shared out: a thousand small arrays would be twice as large.
    """
    STORED.mkdir(exist_ok=True)
    for group in {case.split("/")[0] for case in found}:
        cases = {**read(group), **{k: v for k, v in found.items() if k.split("/")[0] == group}}
        index, values = [], defaultdict(list)
        for case, arrays in cases.items():
            for name, array in arrays.items():
                index.append([case, name, str(array.dtype), array.shape])
                values[str(array.dtype)].append(array.ravel())
        rows = {dtype: np.concatenate(parts) for dtype, parts in values.items()}
        np.savez_compressed(STORED / f"{group}.npz", index=json.dumps(index), **rows)


def read(group: str) -> dict[str, Arrays]:
    """Case -> name -> array of the cases of a group; empty if nothing is stored."""
    path = STORED / f"{group}.npz"
    found: dict[str, Arrays] = {}
    if not path.exists():
        return found
    with np.load(path) as file:
        rows = {name: file[name] for name in file.files}
    begin = dict.fromkeys(rows, 0)
    for case, name, dtype, shape in json.loads(str(rows["index"])):
        end = begin[dtype] + math.prod(shape)
        found.setdefault(case, {})[name] = rows[dtype][begin[dtype] : end].reshape(shape)
        begin[dtype] = end
    return found
