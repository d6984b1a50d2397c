"""Reads PLY, text or binary of either byte order: vertices, polygons, colours, textures."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.mesh_formats.part import (
    MeshFolder,
    Part,
    Polygons,
    bytes_of_colours,
    check_size,
    columns_of,
    text_of,
)

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "float32": "f4", "double": "f8"},
    **{"float64": "f8", "float16": "f2", "half": "f2"},
}
_CODES = {
    **{"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"},
    **{"f2": "e", "f4": "f", "f8": "d"},
}
_MOST_HEADER_BYTES = 1 << 20
_COLOURS = (
    *(("red", "green", "blue"), ("r", "g", "b")),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
_UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_INDICES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Property:
    """A scalar property, or a list if ``count`` is set to the type of its length."""

    name: str
    kind: str
    count: str = ""


@dataclass
class _List:
    """Concatenated lists: lengths (N,), and all values."""

    lengths: Int64
    values: NDArray[Any]


@dataclass
class _Element:
    """An element: its header, and later its data."""

    name: str
    length: int
    properties: list[_Property] = field(default_factory=list)
    numbers: dict[str, NDArray[Any]] = field(default_factory=dict)
    lists: dict[str, _List] = field(default_factory=dict)


def read_ply(data: bytes, folder: MeshFolder) -> list[Part]:
    """Read the parts of a file, one per texture, or a point cloud.

    Raises:
        InputError: an invalid header, or less data than it declares.
    """
    header, body = _split(data)
    order, elements, textures = _parse(header)
    is_text = order == "="
    if is_text:  # all numbers get one type and are read like a binary file
        body, order = np.fromstring(text_of(body), sep=" ").tobytes(), "<"
    place = 0
    for element in elements.values():
        declared = element.properties
        if is_text:
            element.properties = [_Property(p.name, "f8", p.count and "f8") for p in declared]
        place = _read(element, body, place, order)
        for p in declared if is_text else ():
            if p.name in element.numbers:
                element.numbers[p.name] = element.numbers[p.name].astype(p.kind)
    return _parts(elements, textures, folder)


def _split(data: bytes) -> tuple[list[str], bytes]:
    """Split into the header's lines and the body."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    end = data.find(b"end_header", 0, _MOST_HEADER_BYTES)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise InputError("no header of a PLY")
    return text_of(data[:end]).split("\n"), data[newline + 1 :]


def _parse(header: list[str]) -> tuple[str, dict[str, _Element], list[str]]:
    """Parse the header: byte order (``=`` for text), elements by name, texture names."""
    order, elements, textures = "", {}, []
    element = _Element("", 0)
    for line in header[1:]:
        match line.split():
            case ["format", "ascii", *_]:
                order = "="
            case ["format", "binary_little_endian", *_]:
                order = "<"
            case ["format", "binary_big_endian", *_]:
                order = ">"
            case ["element", name, length] if length.isdecimal() and len(length) < 19:
                element = elements[name] = _Element(name, int(length))
            case ["property", "list", count, kind, name] if {count, kind} <= _TYPES.keys():
                element.properties.append(_Property(name, _TYPES[kind], _TYPES[count]))
            case ["property", kind, name] if kind in _TYPES:
                element.properties.append(_Property(name, _TYPES[kind]))
            case ["comment", word, *_] if word.lower() == "texturefile":
                textures.append(line[line.index(word) + len(word) :].strip())
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"header line {line.strip()!r}")
    if not order:
        raise InputError("its header names no format")
    return order, elements, textures


def _read(element: _Element, body: bytes, place: int, order: str) -> int:
    """Read an element starting at ``place``; return the end position."""
    properties = element.properties
    if not properties or not element.length:
        return place
    found, _ = _walk(properties, 1, body, place, order)
    fields: list[Any] = []
    for k, (p, one) in enumerate(zip(properties, found, strict=True)):
        fields += [(f"length {k}", order + p.count)] if p.count else []
        fields += [(str(k), order + p.kind, (len(one.values),) if p.count else ())]
    table = np.dtype(fields)
    end = place + element.length * table.itemsize
    rows = None if end > len(body) else np.frombuffer(body, table, element.length, place)
    is_list = [k for k, p in enumerate(properties) if p.count]
    if is_list and (
        rows is None or any((rows[f"length {k}"] != len(found[k].values)).any() for k in is_list)
    ):
        found, end = _walk(properties, element.length, body, place, order)
    elif rows is None:
        raise InputError(f"element {element.name} ends beyond the file")
    else:
        found = [
            _List(np.full(element.length, len(one.values)), rows[str(k)].reshape(-1))
            for k, one in enumerate(found)
        ]
    for p, one in zip(properties, found, strict=True):
        if p.count:
            element.lists[p.name] = one
        else:
            element.numbers[p.name] = one.values
    return end


def _walk(
    properties: list[_Property], count: int, body: bytes, place: int, order: str
) -> tuple[list[_List], int]:
    """Read ``count`` records one by one; return each property's values, and the end position."""
    check_size(count)
    pieces: list[list[bytes]] = [[] for _ in properties]
    lengths: list[list[int]] = [[] for _ in properties]
    sizes = [np.dtype(p.kind).itemsize for p in properties]
    counts = [p.count and struct.Struct(order + _CODES[p.count]) for p in properties]
    for _ in range(count):
        for k, size in enumerate(sizes):
            length = 1
            if reader := counts[k]:
                if place + reader.size > len(body):
                    raise InputError("it ends within an element")
                length = int(reader.unpack_from(body, place)[0])
                place += reader.size
            if length < 0 or place + length * size > len(body):
                raise InputError("it ends within an element")
            pieces[k].append(body[place : place + length * size])
            lengths[k].append(length)
            place += length * size
    found = [
        _List(np.array(lengths[k]), np.frombuffer(b"".join(pieces[k]), order + p.kind))
        for k, p in enumerate(properties)
    ]
    return found, place


def _parts(elements: dict[str, _Element], textures: list[str], folder: MeshFolder) -> list[Part]:
    if "vertex" not in elements:
        raise InputError("it has no vertices")
    if not elements["vertex"].length:
        return []
    of_vertex = elements["vertex"].numbers
    vertices = columns_of(of_vertex, ("x", "y", "z"))
    if vertices is None:
        raise InputError("its vertices have no x, y, z")
    vertices = vertices.astype(np.float64)
    face = elements.get("face", _Element("face", 0))
    indices = next((face.lists[name] for name in _INDICES if name in face.lists), None)
    name = folder.mesh.stem
    if indices is None:
        for other in ("tristrips", "face"):
            if other in elements and elements[other].length:
                raise InputError(f"element {other} is not read; triangles are lists vertex_indices")
        return [Part(name, vertices, np.zeros((0, 3), np.int64))]
    fans = Polygons.of_lengths(indices.lengths)
    faces = indices.values.astype(np.int64)[fans.corners]
    whole = Part(name, vertices, faces)  # refuses missing vertices
    if textures and (uv := _uv(of_vertex, face, indices, fans, faces)) is not None:
        which = np.zeros(len(faces), np.int64)
        if len(textures) > 1 and "texnumber" in face.numbers:
            which = face.numbers["texnumber"].astype(np.int64)[fans.polygon]
        which = np.clip(which, 0, len(textures) - 1)
        return [
            Part(texture, vertices, faces[which == k], uv[which == k], folder.texture(texture))
            for k, texture in enumerate(textures)
        ]
    if textures:
        folder.warn(f"{textures[0]!r} is not read, for there are no texture coordinates")
    colours = columns_of(of_vertex, *_COLOURS)
    if colours is not None:
        return [Part(name, vertices, faces, colours=bytes_of_colours(colours)[faces])]
    colours = columns_of(face.numbers, *_COLOURS)
    if colours is not None:
        corners = np.repeat(bytes_of_colours(colours)[fans.polygon, None], 3, 1)
        return [Part(name, vertices, faces, colours=corners)]
    return [whole]


def _uv(
    of_vertex: dict[str, NDArray[Any]], face: _Element, indices: _List, fans: Polygons, faces: Int64
) -> Float64 | None:
    """Texture coordinates (T, 3, 2), from the faces' corners or else from the vertices."""
    corners = face.lists.get("texcoord")
    if corners is not None and (corners.lengths == 2 * indices.lengths).all():
        uv = corners.values.reshape(-1, 2)[fans.corners]
    elif (columns := columns_of(of_vertex, *_UV)) is not None:
        uv = columns[faces]
    else:
        return None
    return uv.astype(np.float64) * (1.0, -1.0) + (0.0, 1.0)  # v points up in the file
