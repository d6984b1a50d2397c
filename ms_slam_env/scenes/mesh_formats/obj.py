"""Reads Wavefront OBJ with its materials (MTL): colour and texture, no other shading."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env._runtime.input_files import MAX_TEXT_BYTES
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.mesh_formats.part import (
    Image,
    MeshFolder,
    MissingFileError,
    Part,
    Polygons,
    bytes_of_colours,
    text_of,
)

_WORDS_OF_OPTION = {
    **dict.fromkeys(("-blendu", "-blendv", "-cc", "-clamp", "-bm", "-boost", "-imfchan"), 1),
    **{"-texres": 1, "-type": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3},
}


@dataclass(frozen=True)
class _Material:
    """A material's appearance.

    Attributes:
        colour: (3,) sRGB in [0, 255].
        image: texture image.
        scale: (2,) factor on texture coordinates.
        offset: (2,) added after scaling.
    """

    colour: Float64 | None = None
    image: Image | None = None
    scale: Float64 = field(default_factory=lambda: np.ones(2))
    offset: Float64 = field(default_factory=lambda: np.zeros(2))


@dataclass
class _Group:
    """Faces of one material: each corner's word, face by face, and corners per face."""

    name: str
    corners: list[str] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)


def read_obj(data: bytes, folder: MeshFolder) -> list[Part]:
    """Read the parts of a file, one per material, or a point cloud.

    Raises:
        InputError: invalid numbers, or faces with missing vertices.
    """
    vertices: list[str] = []
    uv: list[str] = []
    libraries: list[str] = []
    groups: dict[str | None, _Group] = {}
    part, material = folder.mesh.stem, None
    for line in _lines(text_of(data)):
        key, _, rest = line.partition(" ")
        if key == "v":
            vertices.append(rest)
        elif key == "vt":
            uv.append(rest)
        elif key == "f":
            words = rest.split()
            if "-" in rest:
                words = [_from_start(word, len(vertices), len(uv)) for word in words]
            group = groups.setdefault(material, _Group(material or part))
            group.corners += words
            group.lengths.append(len(words))
        elif key == "usemtl":
            material = rest.strip()
        elif key in ("o", "g") and rest:
            part = rest.strip()
        elif key == "mtllib":
            libraries.append(rest.strip())
    places, colours = _vertices(vertices)
    if not groups:
        return [Part(part, places, np.zeros((0, 3), np.int64))]
    materials = _materials(libraries, folder)
    missing = sorted({name for name in groups if name is not None} - materials.keys())
    if missing and materials:
        folder.warn(f"no material {missing[0]!r} is found: the surface stays plain")
    coordinates = _table(uv, 2)[:, :2]
    return [
        _part(group, materials.get(name or "", _Material()), places, colours, coordinates)
        for name, group in groups.items()
    ]


def _lines(text: str) -> Iterator[str]:
    """Lines with words separated by single spaces; continued lines are joined."""
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        if line and not line.startswith("#"):
            yield " ".join(line.split())


def _from_start(word: str, vertices: int, uv: int) -> str:
    """Make the indices of a corner ``v/vt/vn`` absolute; negative ones count back from here."""
    counts = (vertices, uv)
    parts = word.split("/")[:2]
    back = [part.startswith("-") for part in parts]
    return "/".join(
        str(count + 1 + int(part)) if is_back else part
        for part, count, is_back in zip(parts, counts, back, strict=False)
    )


def _table(rows: list[str], least: int) -> Float64:
    """Parse rows to numbers (N, k); k is the length of the shortest row."""
    if not rows:
        return np.zeros((0, least))
    words = [row.count(" ") + 1 for row in rows]
    columns = min(words)
    if columns < least:
        raise InputError(f"{rows[words.index(columns)]!r} is not {least} numbers")
    if max(words) > columns:
        rows = [" ".join(row.split(" ")[:columns]) for row in rows]
    return np.fromstring(" ".join(rows), sep=" ").reshape(len(rows), columns)


def _vertices(rows: list[str]) -> tuple[Float64, Float64 | None]:
    """Positions (V, 3), and colours (V, 3) in [0, 255] if every vertex has one."""
    table = _table(rows, 3)
    return table[:, :3], bytes_of_colours(table[:, 3:6]) if table.shape[1] >= 6 else None


def _indices(words: list[str]) -> tuple[Int64, Int64]:
    """Vertex and texture-coordinate indices (C,) of corners, from 1; 0 = none."""
    slashes = {word.count("/") for word in words}
    text = " ".join(words)
    if len(slashes) == 1 and "//" not in text:
        each = np.fromstring(text.replace("/", " "), np.int64, sep=" ").reshape(len(words), -1)
        return each[:, 0], each[:, 1] if each.shape[1] > 1 else np.zeros(len(words), np.int64)
    parts = [word.split("/") for word in words]
    first = np.array([int(part[0]) for part in parts])
    second = np.array([int(part[1]) if len(part) > 1 and part[1] else 0 for part in parts])
    return first, second


def _part(
    group: _Group, material: _Material, places: Float64, colours: Float64 | None, uv: Float64
) -> Part:
    vertex, coordinate = _indices(group.corners)
    fans = Polygons.of_lengths(np.array(group.lengths, np.int64))
    if vertex.min() < 1 or coordinate.min() < 0 or coordinate.max() > len(uv):
        raise InputError("a face refers to a vertex beyond the last")
    faces = vertex[fans.corners] - 1
    part = Part(group.name, places, faces, tint=material.colour)  # refuses missing vertices
    if material.image is not None:
        centre = np.concatenate([uv, [[0.5, 0.5]]])  # the last row is for corners without any
        corners = centre[coordinate[fans.corners] - 1] * material.scale + material.offset
        corners = corners * (1.0, -1.0) + (0.0, 1.0)  # v points up in the file
        return replace(part, uv=corners, image=material.image, tint=None)
    return part if colours is None else replace(part, colours=colours[faces], tint=None)


def _materials(libraries: list[str], folder: MeshFolder) -> dict[str, _Material]:
    """Materials of all libraries by name; a line may list several files, with spaces in names."""
    found: dict[str, _Material] = {}
    for line in libraries:
        try:
            names = [line] if folder.find(line) else []
        except MissingFileError:
            names = (
                line.split() if all(n.lower().endswith(".mtl") for n in line.split()) else [line]
            )
        for name in names:
            try:
                text = text_of(folder.read(name, "material", MAX_TEXT_BYTES))
            except MissingFileError as error:
                folder.warn(f"{error}: surfaces stay plain")
                continue
            found |= _library(text, folder)
    return found


def _library(text: str, folder: MeshFolder) -> dict[str, _Material]:
    found: dict[str, _Material] = {}
    name = ""
    for line in text.splitlines():
        key, *words = line.split() or [""]
        rest = line.strip()[len(key) :].strip()
        if key == "newmtl":
            name = " ".join(words)
            found[name] = _Material()
        elif name and key.lower() == "kd" and len(words) == 3:
            colour = 255.0 * np.clip(np.array(words, dtype=np.float64), 0.0, 1.0)
            found[name] = replace(found[name], colour=colour)
        elif name and key.lower() == "map_kd":
            file, scale, offset = _map(rest)
            image = folder.texture(file)
            found[name] = replace(found[name], image=image, scale=scale, offset=offset)
    return found


def _map(text: str) -> tuple[str, Float64, Float64]:
    """Parse a texture's file, scale (2,) and offset (2,): options, then a name with spaces."""
    values = {"-s": np.ones(2), "-o": np.zeros(2)}
    while (option := text.partition(" ")[0]) in _WORDS_OF_OPTION:
        text = text.partition(" ")[2].lstrip()
        for k in range(_WORDS_OF_OPTION[option]):
            word, _, after = text.partition(" ")
            if k and not _is_number(word):  # -o, -s and -t have one to three numbers
                break
            text = after.lstrip()
            if k < 2 and option in values and _is_number(word):
                values[option][k] = float(word)
    return text, values["-s"], values["-o"]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
