"""Ray casting against the triangles of a scene: what each ray meets first."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from ms_slam_env._warp import wp
from ms_slam_env.scenes.base import TexturedMesh
from ms_slam_env.sensor.rays import query_rays


class Hits:
    """First hit of N rays, as Warp arrays on one device, overwritten by the next cast.

    Attributes:
        t: (N,) float32 ray parameter, origin + t * direction; undefined where ``face`` is -1.
        u: (N,) float32 barycentric weight of the face's second corner.
        v: (N,) float32 barycentric weight of the face's third corner.
        face: (N,) int32 index of the face, -1 where the ray meets nothing.
    """

    def __init__(self, count: int, device: str) -> None:
        """Allocate room for ``count`` rays."""
        self.t = wp.zeros(count, dtype=wp.float32, device=device)
        self.u = wp.zeros(count, dtype=wp.float32, device=device)
        self.v = wp.zeros(count, dtype=wp.float32, device=device)
        self.face = wp.zeros(count, dtype=wp.int32, device=device)


class RayCaster(ABC):
    """Finds the first triangle that each ray meets."""

    @abstractmethod
    def cast(self, origins: wp.array, directions: wp.array, hits: Hits) -> None:
        """Cast rays (N,) vec3 each, directions of any length, and write the result to ``hits``."""


class EmbreeRayCaster(RayCaster):
    """Intel Embree on the CPU, one thread."""

    def __init__(self, mesh: TexturedMesh) -> None:
        """Build Embree's acceleration structure."""
        self._scene = EmbreeScene()
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
        self._geometry = TriangleMesh(self._scene, corners)

    def cast(self, origins: wp.array, directions: wp.array, hits: Hits) -> None:
        """Cast rays (N,) that live on the CPU."""
        result = self._scene.run(origins.numpy(), directions.numpy(), output=True)
        np.copyto(hits.t.numpy(), result["tfar"])
        np.copyto(hits.u.numpy(), result["u"])
        np.copyto(hits.v.numpy(), result["v"])
        np.copyto(hits.face.numpy(), result["primID"])


class WarpRayCaster(RayCaster):
    """Warp's bounding volume hierarchy, on the CPU or on CUDA."""

    def __init__(self, mesh: TexturedMesh, device: str) -> None:
        """Build the hierarchy on ``device``."""
        self._device = device
        self._mesh = wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device=device),
        )

    def cast(self, origins: wp.array, directions: wp.array, hits: Hits) -> None:
        """Cast rays (N,) that live on the device of the mesh."""
        wp.launch(
            query_rays,
            dim=origins.shape[0],
            inputs=[self._mesh.id, origins, directions],
            outputs=[hits.t, hits.u, hits.v, hits.face],
            device=self._device,
        )


def make_caster(mesh: TexturedMesh, device: str) -> RayCaster:
    """Return the fastest caster of a device: Embree on the CPU, Warp elsewhere."""
    return EmbreeRayCaster(mesh) if device == "cpu" else WarpRayCaster(mesh, device)
