"""Ray casting against the triangles of a scene: what the ray of each pixel meets first."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from ms_slam_env._warp import wp
from ms_slam_env.scenes.base import TexturedMesh
from ms_slam_env.sensor.embree import (
    TILE_HEIGHT,
    TILE_WIDTH,
    PacketScene,
    cast_tiles,
    embree_library,
)
from ms_slam_env.sensor.rays import Pinhole, cast_rays, generate_rays


class Hits:
    """First hit of N rays, as Warp arrays on one device, overwritten by the next cast.

    Attributes:
        shape: (B, H, W) of the images whose rays they are, N = B * H * W.
        t: (N,) float32 ray parameter, which is the depth; undefined where ``face`` is -1.
        u: (N,) float32 barycentric weight of the face's second corner.
        v: (N,) float32 barycentric weight of the face's third corner.
        face: (N,) int32 index of the face, -1 where the ray meets nothing.
    """

    def __init__(self, shape: tuple[int, int, int], device: str) -> None:
        """Allocate room for the rays of images (B, H, W), in that order."""
        self.shape = shape
        count = math.prod(shape)
        self.t = wp.zeros(count, dtype=wp.float32, device=device)
        self.u = wp.zeros(count, dtype=wp.float32, device=device)
        self.v = wp.zeros(count, dtype=wp.float32, device=device)
        self.face = wp.zeros(count, dtype=wp.int32, device=device)


class RayCaster(ABC):
    """Finds the first triangle that the ray of each pixel meets."""

    @abstractmethod
    def bind(self, poses: wp.array, camera: Pinhole, hits: Hits) -> Callable[[], None]:
        """Return a function that casts the rays of poses (B,) mat44 and overwrites ``hits``.

        Where ``camera.rows`` rows share a pose there are as many poses an image as that makes; an
        even number, because two rows are cast together.
        It reads the poses anew at each call.
        """


class EmbreeRayCaster(RayCaster):
    """Intel Embree on the CPU, one thread, packets of eight rays."""

    def __init__(self, mesh: TexturedMesh) -> None:
        """Build Embree's acceleration structure.

        Raises:
            OSError: Embree's packet functions cannot be reached.
        """
        library = embree_library()
        if library is None:
            raise OSError("the installed embreex does not give access to Embree 4's ray packets")
        self._scene = PacketScene(library, mesh.vertices, mesh.faces)

    def bind(self, poses: wp.array, camera: Pinhole, hits: Hits) -> Callable[[], None]:
        """See the base class; the arrays live on the CPU."""
        batch, height, width = hits.shape
        command = wp.launch(
            cast_tiles,
            dim=(batch, -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)),
            inputs=[self._scene.intersect, self._scene.scene, poses, camera],
            outputs=[hits.t, hits.u, hits.v, hits.face],
            device="cpu",
            record_cmd=True,
        )
        return command.launch


class EmbreeSingleRayCaster(RayCaster):
    """Intel Embree on the CPU, one ray at a time, through embreex's own interface."""

    def __init__(self, mesh: TexturedMesh) -> None:
        """Build Embree's acceleration structure."""
        self._scene = EmbreeScene()
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
        self._geometry = TriangleMesh(self._scene, corners)

    def bind(self, poses: wp.array, camera: Pinhole, hits: Hits) -> Callable[[], None]:
        """See the base class; the arrays live on the CPU."""
        count = math.prod(hits.shape)
        origins = wp.zeros(count, dtype=wp.vec3, device="cpu")
        directions = wp.zeros(count, dtype=wp.vec3, device="cpu")
        generate = wp.launch(
            generate_rays,
            dim=hits.shape,
            inputs=[poses, camera],
            outputs=[origins, directions],
            device="cpu",
            record_cmd=True,
        )

        def cast() -> None:
            generate.launch()
            result = self._scene.run(origins.numpy(), directions.numpy(), output=True)
            np.copyto(hits.t.numpy(), result["tfar"])
            np.copyto(hits.u.numpy(), result["u"])
            np.copyto(hits.v.numpy(), result["v"])
            np.copyto(hits.face.numpy(), result["primID"])

        return cast


class WarpRayCaster(RayCaster):
    """Warp's bounding volume hierarchy, on the CPU or on CUDA."""

    def __init__(self, mesh: TexturedMesh, device: str) -> None:
        """Build the hierarchy on ``device``."""
        self._device = device
        self._mesh = wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device=device),
        )

    def bind(self, poses: wp.array, camera: Pinhole, hits: Hits) -> Callable[[], None]:
        """See the base class; the arrays live on the device of the mesh."""
        command = wp.launch(
            cast_rays,
            dim=hits.shape,
            inputs=[self._mesh.id, poses, camera],
            outputs=[hits.t, hits.u, hits.v, hits.face],
            device=self._device,
            record_cmd=True,
        )
        return command.launch


def make_caster(mesh: TexturedMesh, device: str) -> RayCaster:
    """Return the fastest caster of a device: Embree on the CPU, Warp elsewhere."""
    if device != "cpu":
        return WarpRayCaster(mesh, device)
    return EmbreeSingleRayCaster(mesh) if embree_library() is None else EmbreeRayCaster(mesh)
