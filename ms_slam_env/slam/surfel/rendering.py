"""Renders surfel maps: holds the buffers of one image size and runs the splatting kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ms_slam_env._runtime.warp import RecordedLaunch, wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel import splatting
from ms_slam_env.slam.surfel.frustum_culling import FrustumCuller
from ms_slam_env.slam.surfel.surfels import MapBuffers, SeenWindow, SplatCamera, VisibleList


@dataclass(frozen=True)
class ModelView:
    """The map rendered from one pose per env, on the device.

    The view may hold only every n-th row and column of the camera's image.
    """

    # (B, H, W) vec3 camera frame of the rendering pose; z = 0 where the map is empty.
    vertices: wp.array
    normals: wp.array  # (B, H, W) vec3 unit normals, same frame, towards the camera; 0 where empty
    intensity: wp.array  # (B, H, W) float32 in [0, 255]; 0 where empty
    color: wp.array  # (B, H, W) vec3 RGB in [0, 255]; 0 where empty


@dataclass(frozen=True)
class SplatParameters:
    """How discs are drawn; see ``SplatCamera``."""

    tolerance_m: float
    z_near: float = 0.05
    z_far: float = 12.0
    min_px: float = 0.6
    max_px: float = 5.0
    max_weight: float = 20.0


def splat_camera(intrinsics: Intrinsics, parameters: SplatParameters) -> SplatCamera:
    """The camera as the kernels take it."""
    camera = SplatCamera()
    camera.width, camera.height = intrinsics.width, intrinsics.height
    camera.focal = wp.vec2(intrinsics.fx, intrinsics.fy)
    camera.centre = wp.vec2(intrinsics.cx, intrinsics.cy)
    for name, value in vars(parameters).items():
        setattr(camera, name, value)
    return camera


class SplatRenderer:
    """Renders ``envs`` of the maps in ``buffers``, one pose each, at one image size.

    The launches are recorded once: a recorded one costs a fifth of packing its arguments anew.

    ``splat`` overwrites ``view``; ``cull`` fills ``visible``, as other renderers of the map do.
    Only surfels last seen within ``window`` are drawn; None: all.
    """

    def __init__(
        self,
        buffers: MapBuffers,
        envs: int,
        intrinsics: Intrinsics,
        parameters: SplatParameters,
        window: SeenWindow | None = None,
    ) -> None:
        self.envs = envs
        self.intrinsics = intrinsics
        self.device = buffers.device
        self.camera = splat_camera(intrinsics, parameters)
        self.view = view = self._new_view()
        self.visible = buffers.visible
        self._buffers = buffers
        pixels = envs * intrinsics.width * intrinsics.height
        self._z_buffer = wp.zeros(pixels, dtype=wp.float32, device=self.device)
        self._sums = wp.zeros(pixels, dtype=splatting.Sums, device=self.device)
        self._culler = FrustumCuller(buffers, envs, self.camera, window)
        self._splats: dict[tuple[int, int], list[RecordedLaunch]] = {}
        images = [a.flatten() for a in (view.vertices, view.normals, view.intensity, view.color)]
        dim, inputs = (envs, intrinsics.height), [self._sums, self.camera, *images]
        self._resolve = RecordedLaunch(splatting.resolve, dim, inputs, self.device)

    def _new_view(self) -> ModelView:
        def image(dtype: Any) -> wp.array:
            return wp.zeros((self.envs, *self.intrinsics.shape), dtype=dtype, device=self.device)

        return ModelView(image(wp.vec3), image(wp.vec3), image(wp.float32), image(wp.vec3))

    def cull(
        self,
        poses: wp.array,
        first_env: int = 0,
        margin_px: float = 1.0,
        layers: float = math.inf,
    ) -> None:
        """List the surfels that the cameras at ``poses`` (envs,) T_world_camera can see.

        Of many discs to a pixel only so many that ``layers`` surfaces of them are left.
        """
        self._culler(poses, first_env, margin_px, layers)

    def splat(self, first_env: int = 0, listed: VisibleList | None = None) -> ModelView:
        """Draw the surfels that ``cull`` listed, or those of another list."""
        listed = self.visible if listed is None else listed
        self._z_buffer.zero_()
        self._sums.zero_()
        self._buffers.footprints.num_drawn.zero_()
        key = (id(listed), first_env)
        if key not in self._splats:
            self._splats[key] = self._record_splats(listed, first_env)
        for launch in (*self._splats[key], self._resolve):
            launch.launch()
        return self.view

    def _record_splats(self, listed: VisibleList, first_env: int) -> list[RecordedLaunch]:
        """The three passes over the surfels of a list."""
        surfels, workers = self._buffers.surfels, self._buffers.workers
        shared = [listed, self.camera, workers, self._buffers.footprints]
        listed_in = [surfels, listed, first_env, *shared[1:]]
        passes = (
            (splatting.project_footprints, shared),
            (splatting.splat_depth, [*shared, self._z_buffer]),
            (splatting.splat_attributes, [*listed_in, self._z_buffer, self._sums]),
        )
        dim = (self.envs, workers)
        return [RecordedLaunch(kernel, dim, inputs, self.device) for kernel, inputs in passes]

    def list_hidden(self, hidden: VisibleList) -> None:
        """List the culled surfels that lie well behind the surface that ``splat`` just drew."""
        hidden.count.zero_()
        workers = self._buffers.workers
        inputs = [self.visible, self.camera, workers, self._z_buffer, hidden]
        wp.launch(splatting.list_hidden, (self.envs, workers), inputs, device=self.device)
