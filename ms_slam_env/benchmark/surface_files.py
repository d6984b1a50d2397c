"""Points of a surface from a file: a point cloud as it is, a mesh sampled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.errors import InputError

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceFile:
    """What a file holds.

    Attributes:
        points: (N, 3) metres.
        kind: ``cloud`` or ``mesh``.
    """

    points: Float64
    kind: str


def read_surface(path: Path, samples: int, seed: int = 0) -> SurfaceFile:
    """Read a cloud or a mesh (PLY, or what else trimesh reads).

    Args:
        path: of the file.
        samples: points taken evenly from the surface of a mesh.
        seed: of that choice.

    Raises:
        InputError: no such file, one that cannot be read, no points in it, or points that are not
            finite.
    """
    import trimesh

    if not path.is_file():
        raise InputError(f"map file {str(path)!r} does not exist")
    try:
        loaded = trimesh.load(path, process=False)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise InputError(f"map file {str(path)!r} cannot be read: {error}") from None
    vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    if vertices.ndim != 2 or len(vertices) == 0:
        raise InputError(f"map file {str(path)!r} holds no points")
    if not np.isfinite(vertices).all():
        raise InputError(f"map file {str(path)!r} holds points that are not finite")
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        return SurfaceFile(vertices, "cloud")
    if not loaded.area > 0:
        raise InputError(f"map file {str(path)!r} holds a mesh without area")
    points, _ = trimesh.sample.sample_surface(loaded, samples, seed=seed)
    return SurfaceFile(np.asarray(points, dtype=np.float64), "mesh")
