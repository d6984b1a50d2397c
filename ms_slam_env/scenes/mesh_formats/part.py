"""Parts returned by mesh readers, and access to the files that a mesh file refers to."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Image, Int64
from ms_slam_env._runtime.input_files import MAX_IMAGE_BYTES, MAX_MESH_BYTES, read_bytes
from ms_slam_env.camera.image_files import decode_texture
from ms_slam_env.errors import InputError, InputWarning

MAX_TRIANGLES = 10_000_000
"""Limit for a mesh file: about 4 GB of memory."""

MAX_TEXELS = 2**28
"""Limit for all textures of a mesh file, after shrinking."""


@dataclass(frozen=True)
class Part:
    """Triangles of one material.

    Attributes:
        name: name in the file.
        vertices: (V, 3) in the file's unit and axes.
        faces: (F, 3) indices of vertices; none in a point cloud.
        uv: (F, 3, 2) of ``image``, u along columns, v along rows from the top.
        image: (h, w, 3) sRGB.
        tint: (3,) sRGB factor in [0, 255] on the image; without an image, the colour.
        colours: (F, 3, 3) sRGB in [0, 255] at the corners, if there is no image.
    """

    name: str
    vertices: Float64
    faces: Int64
    uv: Float64 | None = None
    image: Image | None = None
    tint: Float64 | None = None
    colours: Float64 | None = None

    def __post_init__(self) -> None:
        """Refuse too many faces, and faces with missing vertices."""
        check_size(len(self.faces))
        if self.faces.size and not 0 <= self.faces.min() <= self.faces.max() < len(self.vertices):
            raise InputError(
                f"a face refers to a vertex beyond the {len(self.vertices)} of the mesh"
            )


@dataclass(frozen=True)
class Polygons:
    """Concatenated polygons, cut into triangle fans.

    Attributes:
        corners: (T, 3) indices of the triangles' corners in the list of all polygons' corners.
        polygon: (T,) polygon of each triangle.
    """

    corners: Int64
    polygon: Int64

    @classmethod
    def of_lengths(cls, lengths: Int64) -> Polygons:
        """Cut polygons with ``lengths`` (P,) corners; those with fewer than three are dropped.

        Raises:
            InputError: more triangles than a mesh may have.
        """
        count = np.maximum(lengths - 2, 0)
        check_size(int(count.sum()))
        first, before = np.cumsum(lengths) - lengths, np.cumsum(count) - count
        polygon = np.repeat(np.arange(len(lengths)), count)
        start = first[polygon]
        second = start + 1 + np.arange(len(polygon)) - before[polygon]
        return cls(np.stack([start, second, second + 1], -1), polygon)


def check_size(triangles: int, most: int | None = None) -> None:
    """Refuse more triangles than ``MAX_TRIANGLES``, or than ``most`` if that is less.

    Raises:
        InputError: it names both numbers.
    """
    most = MAX_TRIANGLES if most is None else min(most, MAX_TRIANGLES)
    if triangles > most:
        raise InputError(f"it has {triangles} triangles, more than {most}")


class MissingFileError(InputError):
    """A file that a mesh file refers to is not in its folder."""


@dataclass
class MeshFolder:
    """Files that a mesh file may refer to: regular files in its folder or below.

    Their total size is limited to that of a mesh file. Each is read once.

    Attributes:
        mesh: the mesh file.
    """

    mesh: Path
    _bytes: dict[Path, bytes] = field(default_factory=dict)
    _images: dict[object, Image] = field(default_factory=dict)

    def find(self, name: str) -> Path:
        """Find the file ``name``; ``\\`` also separates folders, and case is ignored.

        An absolute path, such as from another machine, refers to the file of that name beside the
        mesh.

        Raises:
            MissingFileError: there is none, or it is outside the folder.
        """
        folder = Path(os.path.abspath(self.mesh)).parent
        given = PurePosixPath(name.strip().strip('"').replace("\\", "/"))
        why = "is not in its folder"
        for parts in (given.parts, given.parts[-1:]):
            found = None if "\0" in name else _matching(folder, parts)
            if found is not None and found.resolve().is_relative_to(folder.resolve()):
                return found
            why = why if found is None else "lies outside of its folder"
        raise MissingFileError(f"{self.mesh.name} names {name!r}, which {why}")

    def read(self, name: str, kind: str, most_bytes: int = MAX_MESH_BYTES) -> bytes:
        """Read a file's content.

        Raises:
            MissingFileError: see `find`.
            InputError: not a regular file, or too large.
        """
        path = self.find(name)
        if path not in self._bytes:
            left = MAX_MESH_BYTES - sum(map(len, self._bytes.values()))
            self._bytes[path] = read_bytes(
                path, f"{kind} of {self.mesh.name},", min(most_bytes, left)
            )
        return self._bytes[path]

    def texture(self, name: str) -> Image | None:
        """Read an image file; if it is missing, warn and return None.

        Raises:
            InputError: not a regular file, too large, or not an image.
        """
        try:
            path = self.find(name)
            return self.image(path, self.read(name, "texture", MAX_IMAGE_BYTES), str(path))
        except MissingFileError as error:
            self.warn(f"{error}: the surface stays plain")
            return None

    def image(self, key: object, data: bytes, name: str) -> Image:
        """Decode an image once per ``key``; ``name`` is for error messages."""
        if key not in self._images:
            self._images[key] = decode_texture(data, f"texture {name}")
            if sum(image.shape[0] * image.shape[1] for image in self._images.values()) > MAX_TEXELS:
                raise InputError(f"its textures have more than {MAX_TEXELS} pixels")
        return self._images[key]

    def warn(self, text: str) -> None:
        """Warn about a part of the file that is ignored."""
        warnings.warn(f"mesh file {str(self.mesh)!r}: {text}", InputWarning, 4)


def _matching(folder: Path, parts: tuple[str, ...]) -> Path | None:
    """The file at ``parts`` below ``folder``, ignoring case."""
    here = folder
    for part in parts:
        if not os.path.lexists(here / part):
            try:
                names = sorted(n for n in os.listdir(here) if n.casefold() == part.casefold())
            except OSError:
                return None
            if not names:
                return None
            part = names[0]
        here = here / part
    return here if parts else None


def text_of(data: bytes) -> str:
    """Decode text: UTF-8, with or without a byte order mark, else Latin-1."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def bytes_of_colours(values: NDArray[Any]) -> Float64:
    """Convert colours to [0, 255] from 8-bit or 16-bit integers, or floats in [0, 1]."""
    colours = np.nan_to_num(np.asarray(values, dtype=np.float64))
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:
        colours = colours / 257.0
    if values.dtype.kind == "f" and colours.size and colours.max() <= 1.0:
        colours = 255.0 * colours
    return np.clip(colours, 0.0, 255.0)


def columns_of(table: Mapping[str, NDArray[Any]], *choices: tuple[str, ...]) -> NDArray[Any] | None:
    """Stack the columns of the first of ``choices`` whose names are all present."""
    for names in choices:
        if all(name in table for name in names):
            return np.stack([table[name] for name in names], -1)
    return None
