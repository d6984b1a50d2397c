"""Point clouds as binary PLY files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_NAMES = {
    "color": ("red", "green", "blue"),
    "normal": ("nx", "ny", "nz"),
}
_TYPES = {"u1": "uchar", "f4": "float"}


def write_ply(
    path: Path, points: NDArray[np.float64], attributes: dict[str, NDArray[np.generic]]
) -> None:
    """Write points (M, 3) and what is known of each, by name: (M,) or (M, 3) arrays.

    ``color`` is uint8, everything else 32-bit floats. An interrupt leaves no half file.
    """
    columns = {name: np.asarray(points[:, k], "<f4") for k, name in enumerate("xyz")}
    for name, values in attributes.items():
        kind = "u1" if name == "color" else "<f4"
        for k, column in enumerate(np.atleast_2d(values.T)):
            columns[_NAMES.get(name, (name,))[k]] = column.astype(kind)
    table = np.empty(len(points), dtype=[(name, c.dtype) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {_TYPES[c.dtype.str[1:]]} {name}" for name, c in columns.items()),
        "end_header",
    ]
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes("\n".join(lines).encode() + b"\n" + table.tobytes())
    os.replace(partial, path)
