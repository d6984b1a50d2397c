"""Mesh files by name, with optional options: ``room.obj``, ``room.glb,up=z,scale=0.01``."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import MAX_MESH_BYTES, read_bytes
from ms_slam_env.config import Checked, bounded, chosen, from_dict, parse_named
from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from ms_slam_env.scenes.mesh_formats.part import MeshFolder, Part


def _by_trimesh(kind: str) -> Callable[[bytes, MeshFolder], list[Part]]:
    """Reader for formats that refer to no other files and contain no unchecked sizes."""
    import trimesh

    from ms_slam_env.scenes.mesh_formats.part import Part

    def read(data: bytes, folder: MeshFolder) -> list[Part]:
        if data.lstrip().startswith(b"COFF"):
            folder.warn("its colours are not read: the surface stays plain")
        loaded = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
        return [
            Part(folder.mesh.stem, np.asarray(one.vertices, np.float64), np.asarray(one.faces))
            for one in loaded.geometry.values()
            if isinstance(one, trimesh.Trimesh)
        ]

    return read


_READERS = {".glb": "gltf", ".gltf": "gltf", ".obj": "obj", ".ply": "ply"}  # sibling modules


def _reader(suffix: str) -> Callable[[bytes, MeshFolder], list[Part]]:
    """Reader of a format, imported only when needed."""
    if suffix not in _READERS:
        return _by_trimesh(suffix.removeprefix("."))
    kind = _READERS[suffix]
    return getattr(import_module(f"{__name__}.{kind}"), f"read_{kind}")


MESH_SUFFIXES = (*_READERS, ".stl", ".off")
"""Suffixes of mesh files."""

_Y_UP = (".glb", ".gltf")
_NAME = re.compile(rf"(.+({'|'.join(map(re.escape, MESH_SUFFIXES))}))((?:,[^,]*)*)", re.I | re.S)


@dataclass(frozen=True)
class MeshOptions(Checked):
    """How to interpret the coordinates of a mesh file.

    Attributes:
        up: the axis that points up: ``y``, ``z``, or the format's own: y for glTF, z for all
            others.
        scale: metres per unit of the file.
    """

    up: str = chosen("format", "format", "y", "z")
    scale: float = bounded(1.0, 1e-9, 1e9)


@dataclass(frozen=True)
class MeshFile:
    """A mesh file with its options."""

    path: Path
    options: MeshOptions

    @classmethod
    def named(cls, name: object) -> MeshFile | None:
        """Parse ``FILE[,option=value ...]``; None if it is not a mesh file.

        Raises:
            InputError: an unknown option, or a bad value.
        """
        match = _NAME.fullmatch(str(name)) if isinstance(name, (str, Path)) else None
        if match is None:
            return None
        path, _, options = match.groups()
        _, given = parse_named(options, f"mesh file {path!r}")
        return cls(Path(path), from_dict(MeshOptions, given, f"mesh file {path!r}"))

    def check_exists(self) -> None:
        """Refuse a missing file.

        Raises:
            InputError: it names the file.
        """
        if not os.path.exists(self.path):
            raise InputError(f"mesh file {str(self.path)!r} does not exist")

    def read(self) -> list[Part]:
        """Read its parts, world z up, in metres.

        Raises:
            InputError: the file is missing or cannot be read.
        """
        from ms_slam_env.scenes.mesh_formats.part import MeshFolder

        kind = f"mesh file {str(self.path)!r}"
        self.check_exists()
        data = read_bytes(self.path, "mesh file", MAX_MESH_BYTES)
        try:
            with np.errstate(all="ignore"):  # invalid results are refused below
                parts = _reader(self.path.suffix.lower())(data, MeshFolder(self.path))
                shared = {id(part.vertices): part.vertices for part in parts}
                placed = {key: self._placed(vertices) for key, vertices in shared.items()}
                return [replace(part, vertices=placed[id(part.vertices)]) for part in parts]
        except Exception as error:  # damaged files raise anything
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{kind} cannot be read: {reason}") from error

    def _placed(self, vertices: Float64) -> Float64:
        up = self.options.up
        if up == "y" or (up == "format" and self.path.suffix.lower() in _Y_UP):
            vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], -1)
        return vertices if self.options.scale == 1.0 else vertices * self.options.scale
