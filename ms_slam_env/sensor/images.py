"""Image buffers and the recorded kernel launches that fill them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import HostDeviceBuffer, RecordedLaunch, StructTable, wp
from ms_slam_env.scenes.scene import TexturedMesh
from ms_slam_env.sensor.bodies import Body
from ms_slam_env.sensor.casters import RayCaster
from ms_slam_env.sensor.changes import ChangingLight, ChangingView
from ms_slam_env.sensor.depth_noise import DepthNoise, measure_depth, projector_shadow
from ms_slam_env.sensor.native import normal_table, span_of
from ms_slam_env.sensor.noise import NoiseConfig
from ms_slam_env.sensor.rays import Pinhole, make_hits
from ms_slam_env.sensor.shading import Surfaces, Tables, shade, true_geometry
from ms_slam_env.sensor.textures import (
    decode_table,
    encode_table,
    face_planes,
    pack_textures,
    texel_density,
)


def upload_surfaces(mesh: TexturedMesh, device: str) -> Surfaces:
    """Upload the mesh data that shading needs."""
    textures = pack_textures(mesh.textures)
    normals, planes = face_planes(mesh)
    surfaces = Surfaces()
    surfaces.uv = wp.array(mesh.uv, dtype=wp.vec2, device=device)
    surfaces.irradiance = wp.array(mesh.irradiance, dtype=wp.vec3, device=device)
    surfaces.normal = wp.array(normals, dtype=wp.vec3, device=device)
    surfaces.plane = wp.array(planes, dtype=wp.float32, device=device)
    surfaces.density = wp.array(texel_density(mesh), dtype=wp.float32, device=device)
    surfaces.texture = wp.array(mesh.face_texture, dtype=wp.int32, device=device)
    surfaces.label = wp.array(mesh.face_label, dtype=wp.int32, device=device)
    surfaces.texels = wp.array(textures.texels, dtype=wp.uint32, device=device)
    surfaces.offsets = wp.array(textures.offsets, dtype=wp.int32, device=device)
    surfaces.sizes = wp.array(textures.sizes, dtype=wp.vec3i, device=device)
    return surfaces


def upload_tables(device: str) -> Tables:
    """Upload the tables for shading and noise."""
    tables = Tables()
    tables.normals = wp.array(normal_table(), dtype=wp.float32, device=device)
    tables.decode = wp.array(decode_table(), dtype=wp.float32, device=device)
    tables.encode = wp.array(encode_table(), dtype=wp.float32, device=device)
    return tables


@dataclass(frozen=True)
class Changes:
    """What changes from frame to frame in a scene, and the joined mesh of scene and bodies."""

    mesh: TexturedMesh
    bodies: Sequence[Body]
    casters: Sequence[RayCaster]
    light: ChangingLight | None


class Images:
    """Buffers for a batch of images and the kernels that fill them, overwritten by each call.

    Packing the arguments of a launch in Python costs more than a small kernel, so the launches are
    recorded. One thread at a time may use an object.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        camera: Pinhole,
        caster: RayCaster,
        surfaces: Surfaces,
        tables: Tables,
        noise: NoiseConfig,
        depth_noise: DepthNoise,
        exposure: float,
        device: str,
        changes: Changes | None = None,
    ) -> None:
        """Allocate the arrays for images (B, H, W) and record the launches.

        ``camera.rows`` is the number of consecutive rows that share a pose. With ``changes`` there
        is one image.
        """
        self._device = device
        self._shape = shape
        self._camera = camera
        self._surfaces = surfaces
        batch, height, width = shape
        count = batch * height * width
        span = span_of(width, device)
        parts = (batch, height, width // span)
        poses = batch * -(-height // int(camera.rows))
        self._poses = HostDeviceBuffer(poses, wp.mat44, device)
        self._keys = HostDeviceBuffer((batch, 2), wp.uint32, device)
        self._hits = hits = make_hits(count, device)
        self._shadow = wp.zeros(count, dtype=wp.uint8, device=device)
        self._color = HostDeviceBuffer((count, 3), wp.uint8, device)
        self._depth = HostDeviceBuffer(count, wp.float32, device)
        self._cast = caster.bind(self._poses.array, camera, hits, shape)
        self._exposure = exposure
        self._exposures = HostDeviceBuffer(1, wp.float32, device)
        self._exposures.write(exposure)
        self._view = None
        posed_face, posed = hits.face, surfaces
        if changes is not None:
            self._view = view = ChangingView(
                changes.mesh,
                changes.bodies,
                changes.light,
                changes.casters,
                surfaces,
                camera,
                hits,
                device,
            )
            self._surfaces = surfaces = view.surfaces
            posed_face, posed = view.posed_face, view.posed
        self._tables = [StructTable(1, Surfaces, device) for _ in range(2)]
        for table, of in zip(self._tables, (surfaces, posed), strict=True):
            table.put(0, of)
        shown, measured = (table.array for table in self._tables)

        def shading(shot: float, read: float) -> RecordedLaunch:
            seen = [hits, shown, self._exposures.array]
            lookup = [self._keys.array, tables, self._color.array]
            inputs = [self._poses.array, camera, span, *seen, shot, read, *lookup]
            return RecordedLaunch(shade, parts, inputs, device)

        self._shade = shading(noise.shot, noise.read)
        self._shade_ideal = shading(0.0, 0.0)
        self._measure = []
        if noise.shadow:
            inputs = [hits.t, hits.face, width, depth_noise, self._shadow]
            rows = batch * height
            self._measure.append(RecordedLaunch(projector_shadow, rows, inputs, device))
        inputs = [self._poses.array, camera, span, hits.t, posed_face, measured]
        inputs += [self._shadow, depth_noise, self._keys.array, tables.normals, self._depth.array]
        self._measure.append(RecordedLaunch(measure_depth, parts, inputs, device))

    def _look(self, poses: NDArray[np.float64], times_s: NDArray[np.float64] | None) -> None:
        """Cast the rays of the images from poses (P, 4, 4)."""
        self._poses.write(poses)
        if self._view is None:
            self._cast()
            return
        times = np.zeros(len(poses)) if times_s is None else times_s
        self._view.look(self._cast, poses, times)
        self._exposures.write(self._exposure * self._view.exposure_factor)

    def capture(
        self,
        poses: NDArray[np.float64],
        keys: NDArray[np.uint32],
        times_s: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Noisy colour (B, H, W, 3) and depth (B, H, W) from poses (P, 4, 4) with keys (B, 2).

        ``times_s`` (P,) are the poses' times; they matter only if something changes.
        """
        self._keys.write(keys)
        self._look(poses, times_s)
        self._shade.launch()
        for command in self._measure:
            command.launch()
        colors = self._color.look().reshape(*self._shape, 3)
        return colors, self._depth.look().reshape(self._shape)

    def ideal_colors(
        self, poses: NDArray[np.float64], times_s: NDArray[np.float64] | None = None
    ) -> NDArray[np.uint8]:
        """Noise-free colour (B, H, W, 3) from poses (P, 4, 4) at times (P,)."""
        self._look(poses, times_s)
        self._shade_ideal.launch()
        return self._color.look().reshape(*self._shape, 3)

    def true_depth(self, moving: bool = True) -> NDArray[np.float32]:
        """True depth (B, H, W) of the last capture, metres; 0 = no surface, or a moving one."""
        faces = self._hits.face.numpy()
        is_surface = faces >= 0
        if not moving and self._view is not None:
            is_surface &= faces < self._view.first_face
        depth = np.where(is_surface, self._hits.t.numpy(), np.float32(0))
        return depth.reshape(self._shape)

    def truth(
        self, poses: NDArray[np.float64], times_s: NDArray[np.float64] | None = None
    ) -> list[NDArray[Any]]:
        """Noise-free colour, depth, normals, labels and points from poses (P, 4, 4)."""
        self._look(poses, times_s)
        self._shade_ideal.launch()
        count = self._depth.array.shape[0]
        outputs: list[wp.array] = [
            wp.zeros(count, dtype=dtype, device=self._device)
            for dtype in (wp.float32, wp.vec3, wp.int32, wp.vec3)
        ]
        wp.launch(
            true_geometry,
            dim=self._shape,
            inputs=[self._poses.array, self._camera, self._hits, self._surfaces],
            outputs=outputs,
            device=self._device,
        )
        arrays = [self._color.look().copy(), *(array.numpy() for array in outputs)]
        return [array.reshape(*self._shape, *array.shape[1:]) for array in arrays]
