"""Ray queries against a triangle mesh with Embree."""

from __future__ import annotations

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import NDArray

from ms_slam_env.scenes.base import Float64


class RayCaster:
    """An Embree scene of one mesh; not picklable, cheap to rebuild."""

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
        """Build the hierarchy of ``vertices`` (V, 3) and ``faces`` (F, 3)."""
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(
            self._scene,
            np.ascontiguousarray(vertices, dtype=np.float32),
            np.ascontiguousarray(faces, dtype=np.int32),
        )

    def first_hit(
        self, origins: Float64, directions: Float64
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return distance (N,), inf where nothing is hit, and face (N,), -1 there.

        Distances are in units of the length of ``directions`` (N, 3), which need not be 1.
        """
        hit = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            output=1,
        )
        face = np.asarray(hit["primID"], dtype=np.int32)
        return np.where(face >= 0, hit["tfar"], np.inf).astype(np.float32), face
