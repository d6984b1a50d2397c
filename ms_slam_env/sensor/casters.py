"""Ray casters: find the first scene triangle along each pixel's ray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from ms_slam_env._runtime.extension import load_reference
from ms_slam_env._runtime.warp import RecordedLaunch, wp
from ms_slam_env.scenes.scene import TexturedMesh
from ms_slam_env.sensor.embree import (
    TILE_HEIGHT,
    TILE_WIDTH,
    PacketScene,
    cast_tiles,
    embree_library,
)
from ms_slam_env.sensor.rays import Hits, Pinhole, cast_rays


class RayCaster(ABC):
    """Finds the first triangle along each pixel's ray."""

    @abstractmethod
    def bind(
        self, poses: wp.array, camera: Pinhole, hits: Hits, shape: tuple[int, int, int]
    ) -> Callable[[], None]:
        """Return a function that casts the rays of images (B, H, W) and overwrites ``hits``.

        ``poses`` (B,) are mat44, one per image. With a rolling shutter each group of
        ``camera.rows`` rows has its own pose; that number must be even, because two rows are cast
        together. The poses are read at each call.
        """


class EmbreeRayCaster(RayCaster):
    """Intel Embree on the CPU, one thread, packets of eight rays.

    Attributes:
        packets: Embree's scene.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        """Build Embree's acceleration structure.

        Raises:
            OSError: Embree's packet functions cannot be reached.
        """
        library = embree_library()
        if library is None:
            raise OSError("the installed embreex does not give access to Embree 4's ray packets")
        self.packets = PacketScene(library, mesh.vertices, mesh.faces)

    def bind(
        self, poses: wp.array, camera: Pinhole, hits: Hits, shape: tuple[int, int, int]
    ) -> Callable[[], None]:
        """See the base class; the arrays live on the CPU."""
        batch, height, width = shape
        tiles = (batch, -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH))
        scene = self.packets
        triangles = [scene.vertices, scene.faces]
        inputs = [scene.intersect, scene.scene, *triangles, poses, camera, hits]
        return RecordedLaunch(cast_tiles, tiles, inputs, "cpu").launch


class WarpRayCaster(RayCaster):
    """Warp's bounding volume hierarchy, on the CPU or on CUDA.

    Attributes:
        mesh: Warp's mesh.
    """

    def __init__(self, mesh: TexturedMesh, device: str) -> None:
        """Build the hierarchy on ``device``."""
        self._device = device
        self.mesh = wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device=device),
        )

    def bind(
        self, poses: wp.array, camera: Pinhole, hits: Hits, shape: tuple[int, int, int]
    ) -> Callable[[], None]:
        """See the base class; the arrays live on the device of the mesh."""
        inputs = [self.mesh.id, poses, camera, hits]
        return RecordedLaunch(cast_rays, shape, inputs, self._device).launch


_SINGLE = "ms_slam_env.sensor.embree_single:EmbreeSingleRayCaster"


def make_caster(mesh: TexturedMesh, device: str) -> RayCaster:
    """Return the fastest caster of a device: Embree on a CPU that it exists for, otherwise Warp."""
    if device != "cpu":
        return WarpRayCaster(mesh, device)
    if embree_library() is not None:
        return EmbreeRayCaster(mesh)
    try:
        single: RayCaster = load_reference(_SINGLE)(mesh)
    except ImportError:  # no embreex
        return WarpRayCaster(mesh, device)
    return single
