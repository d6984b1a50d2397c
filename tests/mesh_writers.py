"""Small mesh files, written byte by byte: as exporters write them, and as nobody should."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOM = np.array([(x, y, z) for z in (0, 2.5) for y in (0, 4) for x in (0, 6)], dtype=float)
"""Corners (8, 3) of a room of 6 m x 4 m, 2.5 m high."""

QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
"""Its floor, ceiling and walls."""

AREA = 2 * (6 * 4 + 6 * 2.5 + 4 * 2.5)

COLOURS = np.array(
    [
        *([255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]),
        *([0, 255, 255], [255, 0, 255], [10, 10, 10], [250, 250, 250]),
    ],
    np.uint8,
)
"""Of the corners (8, 3)."""

TRIANGLES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def area_of(corners: np.ndarray) -> float:
    """Of triangles (F, 3, 3)."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(cross, axis=1).sum())


def write_png(path: Path, colour: tuple[int, int, int] = (200, 10, 20), side: int = 8) -> None:
    """A plain image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (side, side), colour).save(path, "PNG")


def write_obj(folder: Path, map_line: str, library: str = "room.mtl", uv: str = "0 0") -> Path:
    """A room whose one material has a ``map_Kd`` line, and whose corners all have ``uv``."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"mtllib {library}", *("v {:g} {:g} {:g}".format(*v) for v in ROOM), f"vt {uv}"]
    lines += ["usemtl wall", *("f " + " ".join(f"{i + 1}/1" for i in quad) for quad in QUADS)]
    (folder / "room.obj").write_text("\n".join(lines))
    (folder / "room.mtl").write_text(f"newmtl wall\nKd 0.5 0.5 0.5\n{map_line}\n")
    return folder / "room.obj"


def ply(faces: list[tuple[int, ...]], form: str, kinds: tuple[str, str, str]) -> bytes:
    """A coloured room; kinds of coordinates, of the length of a list, and of its entries."""
    coordinate, count, index = kinds
    codes = {"float": "f", "double": "d", "uchar": "B", "uint8": "B", "int": "i", "uint": "I"}
    header = [f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex 8"]
    header += [f"property {coordinate} {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", f"property list {count} {index} vertex_indices"]
    data = ("\n".join(header) + "\nend_header\n").encode()
    if form == "ascii":
        rows = [[*place, *colour] for place, colour in zip(ROOM, COLOURS.tolist(), strict=True)]
        rows += [[len(face), *face] for face in faces]
        return data + "\n".join(" ".join(map(str, row)) for row in rows).encode()
    order = "<" if "little" in form else ">"
    for place, colour in zip(ROOM, COLOURS.tolist(), strict=True):
        data += struct.pack(f"{order}3{codes[coordinate]}3B", *place, *colour)
    for face in faces:
        data += struct.pack(f"{order}{codes[count]}{len(face)}{codes[index]}", len(face), *face)
    return data


def gltf(**more: Any) -> tuple[dict[str, Any], bytes]:
    """Tree and buffer of a room, y up; what is given stands in the tree instead."""
    places = ROOM[:, [0, 2, 1]] * (1, 1, -1)  # z up to y up
    indices, vertices = TRIANGLES.astype("<u2").tobytes(), places.astype("<f4").tobytes()
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"name": "room", "primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": TRIANGLES.size, "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(indices)},
            {"buffer": 0, "byteOffset": len(indices), "byteLength": len(vertices)},
        ],
        "buffers": [{"byteLength": len(indices) + len(vertices), "uri": "room.bin"}],
    }
    return tree | more, indices + vertices


def textured_gltf() -> tuple[dict[str, Any], bytes]:
    """The room with the texture ``wood.png``, whose coordinates are as good as any."""
    tree, buffer = gltf()
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["material"] = 0
    primitive["attributes"]["TEXCOORD_0"] = 2
    tree["accessors"].append({"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC2"})
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["textures"], tree["images"] = [{"source": 0}], [{"uri": "wood.png"}]
    return tree, buffer


def embedded(buffer: bytes) -> dict[str, Any]:
    """A buffer within the text of a glTF."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    return {"byteLength": len(buffer), "uri": uri}


def write_gltf(folder: Path, tree: dict[str, Any], buffer: bytes | None) -> Path:
    """A glTF with its buffer beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "room.gltf").write_text(json.dumps(tree))
    if buffer is not None:
        (folder / "room.bin").write_bytes(buffer)
    return folder / "room.gltf"


def glb(tree: dict[str, Any], buffer: bytes) -> bytes:
    """The same in one file."""
    tree = tree | {"buffers": [{"byteLength": len(buffer)}]}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    buffer += b"\0" * (-len(buffer) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
