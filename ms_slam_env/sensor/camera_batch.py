# mypy: disable-error-code="attr-defined"
"""Many cameras, each in a scene of its own, whose images stay on the device.

The kernels that shade and measure are those of one scene; they look up each image's scene in a
table, as those here that cast rays, so that one launch renders all of them.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import HostDeviceBuffer, RecordedLaunch, StructTable
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor.casters import EmbreeRayCaster, WarpRayCaster
from ms_slam_env.sensor.depth_noise import (
    make_depth_noise,
    measure_depth,
    projector_shadow,
)
from ms_slam_env.sensor.embree import TILE_HEIGHT, TILE_WIDTH, cast_tile, embree_library
from ms_slam_env.sensor.images import upload_tables
from ms_slam_env.sensor.native import VECTOR_FLAGS, frame_keys, span_of
from ms_slam_env.sensor.noise import NoiseConfig
from ms_slam_env.sensor.rays import Hits, Pinhole, cast_ray, make_hits, make_pinhole
from ms_slam_env.sensor.rgbd import RGBDSensor
from ms_slam_env.sensor.shading import Surfaces, shade

wp.set_module_options(VECTOR_FLAGS)


@wp.struct
class CastScene:
    """What casting rays needs of a scene."""

    mesh: wp.uint64  # Warp's mesh, or the address of Embree's scene
    intersect: wp.uint64  # address of rtcIntersect8, for Embree alone
    vertices: wp.array[wp.vec3]  # (V,) for Embree alone
    faces: wp.array[wp.vec3i]  # (F,) for Embree alone


@wp.kernel
def _cast_rays(
    scenes: wp.array[CastScene],  # (B,)
    T_world_camera: wp.array[wp.mat44],  # (B,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
) -> None:
    b, y, x = wp.tid()
    cast_ray(scenes[b].mesh, T_world_camera[b], camera, b, y, x, hits)


@wp.kernel
def _cast_tiles(
    scenes: wp.array[CastScene],  # (B,)
    T_world_camera: wp.array[wp.mat44],  # (B,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
) -> None:
    b, y, x = wp.tid()
    scene = scenes[b]
    cast_tile(
        scene.intersect,
        scene.mesh,
        scene.vertices,
        scene.faces,
        T_world_camera[b],
        camera,
        b,
        y,
        x,
        hits,
    )


class CameraBatch:
    """B cameras of one kind, each in a scene of its own, that take their frames at once.

    A frame is that of ``RGBDSensor.capture``, on the CPU bit for bit.

    Attributes:
        color: (B, H, W, 3) uint8 on the device, of the last frames.
        depth: (B, H, W) float32 on the device, metres; 0 = no reading.
        hits: of the B * H * W rays: the true depth where a face was hit.
    """

    def __init__(
        self,
        batch: int,
        intrinsics: Intrinsics,
        noise: NoiseConfig,
        device: str = "cpu",
        packets: bool = True,
    ) -> None:
        """Allocate images for B cameras on ``device``.

        With ``packets`` Embree casts the rays on a CPU; otherwise, and on a GPU, Warp does.
        """
        self.intrinsics, self.device = intrinsics, device
        self._uses_embree = packets and device == "cpu" and embree_library() is not None
        self._casters: WeakKeyDictionary[Scene, WarpRayCaster] = WeakKeyDictionary()
        self._scenes = StructTable(batch, CastScene, device)
        self._surfaces = StructTable(batch, Surfaces, device)
        self._exposures = HostDeviceBuffer(batch, wp.float32, device)
        height, width = intrinsics.shape
        shape, count = (batch, height, width), batch * height * width
        camera, span = make_pinhole(intrinsics, device=device), span_of(width, device)
        parts = batch, height, width // span
        self._poses = HostDeviceBuffer(batch, wp.mat44, device)
        self._keys = HostDeviceBuffer((batch, 2), wp.uint32, device)
        self.hits = hits = make_hits(count, device)
        shadow = wp.zeros(count, dtype=wp.uint8, device=device)
        color = wp.zeros((count, 3), dtype=wp.uint8, device=device)
        depth = wp.zeros(count, dtype=wp.float32, device=device)
        self.color, self.depth = color.reshape((*shape, 3)), depth.reshape(shape)
        tables, depth_noise = upload_tables(device), make_depth_noise(noise, intrinsics)
        seen, surfaces = [self._poses.array, camera], self._surfaces.array
        stages: list[tuple[Any, Any, list[Any]]] = []
        tiles = batch, -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)
        cast = (_cast_tiles, tiles) if self._uses_embree else (_cast_rays, shape)
        stages.append((*cast, [self._scenes.array, *seen, hits]))
        lit = [span, hits, surfaces, self._exposures.array]
        shading = [noise.shot, noise.read, self._keys.array, tables, color]
        stages.append((shade, parts, [*seen, *lit, *shading]))
        if noise.shadow:
            inputs = [hits.t, hits.face, width, depth_noise, shadow]
            stages.append((projector_shadow, batch * height, inputs))
        measuring = [span, hits.t, hits.face, surfaces, shadow, depth_noise, self._keys.array]
        stages.append((measure_depth, parts, [*seen, *measuring, tables.normals, depth]))
        self._stages = [RecordedLaunch(*stage, device) for stage in stages]

    def enter(self, camera: int, sensor: RGBDSensor) -> None:
        """Put a camera into the scene of ``sensor``, which is on the same device."""
        self._surfaces.put(camera, sensor.surfaces, sensor)
        exposures = self._exposures.read()
        exposures[camera] = sensor.scene.exposure
        self._exposures.write(exposures)
        seen = CastScene()
        caster = sensor.caster
        if self._uses_embree:
            assert isinstance(caster, EmbreeRayCaster)
            packets = caster.packets
            seen.mesh, seen.intersect = packets.scene, packets.intersect
            seen.vertices, seen.faces = packets.vertices, packets.faces
        else:
            if not isinstance(caster, WarpRayCaster):
                made = self._casters.get(sensor.scene)
                caster = made or WarpRayCaster(sensor.scene.mesh, self.device)
                self._casters[sensor.scene] = caster
            seen.mesh = caster.mesh.id
        self._scenes.put(camera, seen, sensor, caster)

    def capture(
        self, T_world_camera: Float64, seeds: NDArray[np.integer], indices: NDArray[np.integer]
    ) -> None:
        """Take frames ``indices`` (B,) from poses (B, 4, 4) under noise ``seeds`` (B,)."""
        self._poses.write(T_world_camera)
        self._keys.write(frame_keys(seeds, indices))
        for launch in self._stages:
            launch.launch()
