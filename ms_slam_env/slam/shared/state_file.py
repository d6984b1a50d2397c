"""States on disk: arrays in an NPZ file, everything else as JSON beside them; nothing is executed.

A state is nested mappings, lists and tuples of arrays and plain values. Its arrays are numbered in
the archive; ``tree.json`` says where each belongs.
"""

from __future__ import annotations

import io
import json
import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.input_files import MAX_MESH_BYTES, check_file
from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.errors import InputError

FORMAT, VERSION = "ms_slam_env map", 1
MAX_TREE_BYTES = 16 * 1024 * 1024
"""Size limit of the JSON text: a hundred thousand frames with four arrays each need half of it."""
MAX_EXPANSION, ALWAYS_TAKEN_BYTES = 20, 32 * 1024 * 1024
"""How many times a file may grow when unpacked, and the size always accepted. Real maps stay below;
packed zeros grow 1000 times."""
_PIECE_BYTES = 1024 * 1024
_TREE = "tree.json"
_CONTAINERS = {"list": list, "tuple": tuple}
_BROKEN = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, IndexError, AttributeError),
    *(NotImplementedError, RecursionError, MemoryError, OverflowError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError, SyntaxError),  # headers are Python
)
"""Errors that the readers of zip archives, JSON and arrays raise on invalid data."""


def write_state(path: Path, about: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Write a state atomically.

    Args:
        path: path of the file.
        about: description of the state's owner, in JSON types.
        state: as ``Stateful.get_state`` returns it.

    Raises:
        InputError: as in `check_packable`.
        OSError: the file cannot be written.
    """
    header, arrays = _header(about, state)
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(zipfile.ZipInfo(_TREE), header, zipfile.ZIP_DEFLATED)
        for index, array in enumerate(arrays):
            with archive.open(zipfile.ZipInfo(_name(index)), "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    write_bytes(path, data.getvalue())


def check_packable(about: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Refuse a state that `write_state` cannot write, or that would be read back differently.

    Raises:
        InputError: the message names the place and the types that a file can hold.
    """
    _header(about, state)


def _header(about: Mapping[str, Any], state: Mapping[str, Any]) -> tuple[str, list[NDArray[Any]]]:
    """Text of ``tree.json``, and the arrays stored next to it."""
    arrays: list[NDArray[Any]] = []
    tree = _packed(state, arrays, "state")
    header = {"format": FORMAT, "version": VERSION, "about": about, "state": tree}
    try:
        return json.dumps(header), arrays
    except (TypeError, ValueError) as error:  # the tree is JSON by now
        raise InputError(f"a map cannot be saved with these parameters: {error}") from None


def read_state(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read what `write_state` wrote.

    Returns:
        The description ``about``, and the state.

    Raises:
        InputError: no such file, not a state file, another version, or damaged; one line.
    """
    with _opened(path) as (archive, header):
        read: set[str] = set()
        state = _unpacked(header["state"], lambda index: _read_array(archive, index, read))
        return dict(header["about"]), dict(state)


def read_about(path: Path) -> dict[str, Any]:
    """Read only the description of a state file; see `read_state`."""
    with _opened(path) as (_, header):
        return dict(header["about"])


@contextmanager
def _opened(path: Path) -> Iterator[tuple[zipfile.ZipFile, Mapping[str, Any]]]:
    """Open the archive and read its header; any failure becomes one InputError."""
    check_file(path, "map", MAX_MESH_BYTES)
    try:
        with zipfile.ZipFile(path) as archive:
            check_expansion(archive, path.stat().st_size)
            if archive.getinfo(_TREE).file_size > MAX_TREE_BYTES:
                raise InputError(f"{_TREE} is larger than {MAX_TREE_BYTES / 1e6:.0f} MB")
            header = json.loads(archive.read(_TREE))
            _check_version(header)
            yield archive, header
    except InputError as error:
        raise InputError(f"cannot read map {path}: {error}") from None
    except _BROKEN as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot read map {path}: damaged, or no map ({reason})") from None


def check_expansion(archive: zipfile.ZipFile, packed_bytes: int) -> None:
    """Refuse an archive that would grow too much when unpacked, before reading its content.

    Raises:
        InputError: it names the limit.
    """
    most = max(MAX_EXPANSION * packed_bytes, ALWAYS_TAKEN_BYTES)
    if sum(info.file_size for info in archive.infolist()) > most:
        raise InputError(f"larger than {most / 1e6:.0f} MB once unpacked")


def _check_version(header: Mapping[str, Any]) -> None:
    if header["format"] != FORMAT:
        raise InputError(f"it is a file of {header['format']!r}, not of {FORMAT!r}")
    if header["version"] != VERSION:
        raise InputError(f"it has version {header['version']!r}; this program reads {VERSION}")


def _name(index: int) -> str:
    return f"{index}.npy"


def _packed(value: Any, arrays: list[NDArray[Any]], where: str) -> Any:
    """Convert ``value`` to JSON types; arrays and NumPy numbers move to ``arrays``.

    Raises:
        InputError: a file cannot hold the value; the message says ``where`` it is.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        if value.dtype.hasobject:
            raise _unpackable(where, "an array of objects")
        kind = "array" if isinstance(value, np.ndarray) else "number"
        arrays.append(np.asarray(value))
        return {kind: len(arrays) - 1}
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str):
                raise _unpackable(where, f"a mapping with the key {name!r}, not text")
        packed = {name: _packed(one, arrays, f"{where}.{name}") for name, one in value.items()}
        return {"mapping": packed}
    for container, made in _CONTAINERS.items():
        if isinstance(value, made):
            packed_list = [_packed(one, arrays, f"{where}[{k}]") for k, one in enumerate(value)]
            return {container: packed_list}
    if value is not None and not isinstance(value, (bool, int, float, str)):
        raise _unpackable(where, f"a {type(value).__name__}")
    return value


def _unpackable(where: str, what: str) -> InputError:
    return InputError(
        f"a map cannot be saved: {where} is {what}; a file holds numbers, text, arrays, and lists, "
        "tuples and mappings of these"
    )


def _unpacked(tree: Any, array: Callable[[int], NDArray[Any]]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "array":
        return array(content)
    if kind == "number":
        return array(content)[()]
    if kind == "mapping":
        return {name: _unpacked(one, array) for name, one in content.items()}
    return _CONTAINERS[kind](_unpacked(one, array) for one in content)


def _read_array(archive: zipfile.ZipFile, index: int, read: set[str]) -> NDArray[Any]:
    """Read one array; its header must match its real length, and no array may be ``read`` twice."""
    name = _name(index)
    if name in read:
        raise ValueError(f"{name} stands for several arrays")
    read.add(name)
    with archive.open(name) as file:
        version = np.lib.format.read_magic(file)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, is_fortran, dtype = readers[version](file)
        size = archive.getinfo(name).file_size - file.tell()
        if dtype.hasobject or size != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{name} does not match its header")
        data = bytearray()  # in pieces: one copy, not two
        while piece := file.read(_PIECE_BYTES):
            data += piece
    if len(data) != size:
        raise ValueError(f"{name} does not match its header")
    flat = np.frombuffer(data, dtype=dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C")
