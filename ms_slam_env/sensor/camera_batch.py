# mypy: disable-error-code="attr-defined"
"""Many cameras, each in a scene of its own, whose images stay on the device.

The kernels are those of one scene (``rays``, ``embree``, ``shading``, ``depth_noise``), but look up
each image's scene in a table, so that one launch renders all of them.
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
    DepthNoise,
    make_depth_noise,
    measure_span,
    projector_shadow,
)
from ms_slam_env.sensor.embree import TILE_HEIGHT, TILE_WIDTH, cast_tile, embree_library
from ms_slam_env.sensor.images import upload_tables
from ms_slam_env.sensor.native import VECTOR_FLAGS, frame_keys, span_of
from ms_slam_env.sensor.noise import NoiseConfig
from ms_slam_env.sensor.rays import Hits, Pinhole, cast_ray, make_hits, make_pinhole
from ms_slam_env.sensor.rgbd import RGBDSensor
from ms_slam_env.sensor.shading import Surfaces, Tables, shade_span

wp.set_module_options(VECTOR_FLAGS)


@wp.struct
class RenderedScene:
    """What rendering needs of a scene."""

    mesh: wp.uint64  # Warp's mesh, or the address of Embree's scene
    intersect: wp.uint64  # address of rtcIntersect8, for Embree alone
    vertices: wp.array[wp.vec3]  # (V,) for Embree alone
    faces: wp.array[wp.vec3i]  # (F,) for Embree alone
    surfaces: Surfaces
    exposure: wp.float32


@wp.kernel
def _cast_rays(
    scenes: wp.array[RenderedScene],  # (B,)
    T_world_camera: wp.array[wp.mat44],  # (B,)
    camera: Pinhole,
    hits: Hits,  # of B * H * W rays
) -> None:
    b, y, x = wp.tid()
    cast_ray(scenes[b].mesh, T_world_camera[b], camera, b, y, x, hits)


@wp.kernel
def _cast_tiles(
    scenes: wp.array[RenderedScene],  # (B,)
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


@wp.kernel
def _shade(
    scenes: wp.array[RenderedScene],  # (B,)
    T_world_camera: wp.array[wp.mat44],  # (B,)
    camera: Pinhole,
    span: int,
    hits: Hits,  # of B * H * W rays
    shot: float,
    read: float,
    keys: wp.array2d[wp.uint32],  # (B, 2)
    tables: Tables,
    color: wp.array2d[wp.uint8],  # (B * H * W, 3)
) -> None:
    b, y, part = wp.tid()
    scene = scenes[b]
    first = b * camera.height * camera.width
    x = part * span
    count = wp.min(span, camera.width - x)
    shade_span(
        T_world_camera[b],
        camera,
        first,
        y,
        x,
        count,
        hits,
        scene.surfaces,
        scene.exposure,
        shot,
        read,
        keys[b, 0],
        keys[b, 1],
        tables,
        color,
    )


@wp.kernel
def _measure_depth(
    scenes: wp.array[RenderedScene],  # (B,)
    T_world_camera: wp.array[wp.mat44],  # (B,)
    camera: Pinhole,
    span: int,
    hits: Hits,  # of B * H * W rays
    shadow: wp.array[wp.uint8],  # (B * H * W,)
    noise: DepthNoise,
    keys: wp.array2d[wp.uint32],  # (B, 2)
    normals: wp.array[wp.float32],  # quantiles of N(0, 1)
    depth: wp.array[wp.float32],  # (B * H * W,)
) -> None:
    b, y, part = wp.tid()
    scene = scenes[b]
    x = part * span
    measure_span(
        T_world_camera[b],
        camera,
        b * camera.height * camera.width,
        y,
        x,
        wp.min(span, camera.width - x),
        hits.t,
        hits.face,
        scene.surfaces.normal,
        scene.surfaces.plane,
        shadow,
        noise,
        keys[b, 0],
        keys[b, 1],
        normals,
        depth,
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
        self._scenes = StructTable(batch, RenderedScene, device)
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
        seen = [self._scenes.array, self._poses.array, camera]
        stages: list[tuple[Any, Any, list[Any]]] = []
        tiles = batch, -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)
        cast = (_cast_tiles, tiles) if self._uses_embree else (_cast_rays, shape)
        stages.append((*cast, [*seen, hits]))
        shading = [span, hits, noise.shot, noise.read, self._keys.array, tables, color]
        stages.append((_shade, parts, [*seen, *shading]))
        if noise.shadow:
            inputs = [hits.t, hits.face, width, depth_noise, shadow]
            stages.append((projector_shadow, batch * height, inputs))
        measuring = [span, hits, shadow, depth_noise, self._keys.array, tables.normals, depth]
        stages.append((_measure_depth, parts, [*seen, *measuring]))
        self._stages = [RecordedLaunch(*stage, device) for stage in stages]

    def enter(self, camera: int, sensor: RGBDSensor) -> None:
        """Put a camera into the scene of ``sensor``, which is on the same device."""
        seen = RenderedScene()
        seen.surfaces, seen.exposure = sensor.surfaces, sensor.scene.exposure
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
