"""Embree without packets of rays, where the loader does not reach its C interface."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from ms_slam_env._runtime.warp import RecordedLaunch, wp
from ms_slam_env.scenes.scene import TexturedMesh
from ms_slam_env.sensor.casters import RayCaster
from ms_slam_env.sensor.rays import Hits, Pinhole, generate_rays


class EmbreeSingleRayCaster(RayCaster):
    """Intel Embree on the CPU, one ray at a time, through embreex's interface."""

    def __init__(self, mesh: TexturedMesh) -> None:
        """Build Embree's acceleration structure."""
        self._scene = EmbreeScene()
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
        self._geometry = TriangleMesh(self._scene, corners)

    def bind(
        self, poses: wp.array, camera: Pinhole, hits: Hits, shape: tuple[int, int, int]
    ) -> Callable[[], None]:
        """See the base class; the arrays live on the CPU."""
        origins = wp.zeros(math.prod(shape), dtype=wp.vec3, device="cpu")
        directions = wp.zeros(math.prod(shape), dtype=wp.vec3, device="cpu")
        inputs = [poses, camera, origins, directions]
        generate = RecordedLaunch(generate_rays, shape, inputs, "cpu")

        def cast() -> None:
            generate.launch()
            result = self._scene.run(origins.numpy(), directions.numpy(), output=True)
            np.copyto(hits.t.numpy(), result["tfar"])
            np.copyto(hits.u.numpy(), result["u"])
            np.copyto(hits.v.numpy(), result["v"])
            np.copyto(hits.face.numpy(), result["primID"])

        return cast
