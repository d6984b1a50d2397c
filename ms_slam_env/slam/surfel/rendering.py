"""Renders surfel maps: holds the buffers of one image size and runs the splatting kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.frustum_culling import CullingBlocks, FrustumCuller
from ms_slam_env.slam.surfel.splatting import (
    SplatFootprints,
    Sums,
    list_hidden,
    project_footprints,
    resolve,
    splat_attributes,
    splat_depth,
)
from ms_slam_env.slam.surfel.surfels import SeenWindow, SplatCamera, Surfels, VisibleList


@dataclass(frozen=True)
class ModelView:
    """The map rendered from one pose per env, on the device.

    The view may hold only every n-th row and column of the camera's image.

    Attributes:
        vertices: (B, H, W) vec3 camera frame of the rendering pose; z = 0 where the map is empty.
        normals: (B, H, W) vec3 unit normals, same frame, towards the camera; 0 where empty.
        intensity: (B, H, W) float32 in [0, 255]; 0 where empty.
        color: (B, H, W) vec3 RGB in [0, 255]; 0 where empty.
    """

    vertices: wp.array
    normals: wp.array
    intensity: wp.array
    color: wp.array


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
    camera.z_near, camera.z_far = parameters.z_near, parameters.z_far
    camera.tolerance_m = parameters.tolerance_m
    camera.min_px, camera.max_px = parameters.min_px, parameters.max_px
    camera.max_weight = parameters.max_weight
    return camera


class SplatRenderer:
    """Renders ``envs`` of the maps in ``surfels``, one pose each, at one image size.

    The launches are recorded once: a recorded one costs a fifth of packing its arguments anew.

    Args:
        surfels: the maps.
        blocks: their blocks.
        visible: working list of the surfels in view, shared by all renderers of a map.
        discs: working memory for such a list, shared likewise.
        envs: number of images rendered at once.
        intrinsics: of the images.
        parameters: how discs are drawn.
        workers: threads per env; 1 on the CPU, where they would run one after the other.
        device: Warp device.
        window: draw the surfels last seen within it; None: all.

    Attributes:
        view: the images, overwritten by every call of ``splat``.
        visible: the list that ``cull`` fills, overwritten by other renderers of the map.
    """

    def __init__(
        self,
        surfels: Surfels,
        blocks: CullingBlocks,
        visible: VisibleList,
        discs: SplatFootprints,
        envs: int,
        intrinsics: Intrinsics,
        parameters: SplatParameters,
        workers: int,
        device: str,
        window: SeenWindow | None = None,
    ) -> None:
        self.envs = envs
        self.intrinsics = intrinsics
        self.device = device
        self.workers = workers
        self.camera = splat_camera(intrinsics, parameters)
        self.view = self._new_view()
        self.visible = visible
        self._discs = discs
        pixels = envs * intrinsics.width * intrinsics.height
        self._z_buffer = wp.zeros(pixels, dtype=wp.float32, device=device)
        self._sums = wp.zeros(pixels, dtype=Sums, device=device)
        self._culler = FrustumCuller(
            surfels, blocks, visible, envs, self.camera, workers, device, window
        )
        self._splats = {id(visible): self._record_splats(surfels, visible)}
        self._first_env = {id(visible): 0}
        self._surfels = surfels
        self._resolve = wp.launch(
            resolve,
            dim=(envs, intrinsics.height),
            inputs=[
                self._sums,
                self.camera,
                self.view.vertices.flatten(),
                self.view.normals.flatten(),
                self.view.intensity.flatten(),
                self.view.color.flatten(),
            ],
            device=device,
            record_cmd=True,
        )

    def _new_view(self) -> ModelView:
        shape = (self.envs, *self.intrinsics.shape)
        return ModelView(
            vertices=wp.zeros(shape, dtype=wp.vec3, device=self.device),
            normals=wp.zeros(shape, dtype=wp.vec3, device=self.device),
            intensity=wp.zeros(shape, dtype=wp.float32, device=self.device),
            color=wp.zeros(shape, dtype=wp.vec3, device=self.device),
        )

    def _record_splats(
        self, surfels: Surfels, listed: VisibleList
    ) -> tuple[wp.Launch, wp.Launch, wp.Launch]:
        """The three passes over the surfels of a list."""
        camera, workers, discs, z_buffer = self.camera, self.workers, self._discs, self._z_buffer

        def record(kernel: Any, inputs: list[Any]) -> wp.Launch:
            dim = (self.envs, workers)
            return wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_cmd=True)

        shared = [surfels, listed, 0, camera, workers, discs]
        return (
            record(project_footprints, [listed, camera, workers, discs]),
            record(splat_depth, [listed, camera, workers, discs, z_buffer]),
            record(splat_attributes, [*shared, z_buffer, self._sums]),
        )

    def cull(self, poses: wp.array, first_env: int = 0, margin_px: float = 1.0) -> None:
        """List the surfels that the cameras at ``poses`` (envs,) T_world_camera can see."""
        self._culler(poses, first_env, margin_px)

    def splat(self, first_env: int = 0, listed: VisibleList | None = None) -> ModelView:
        """Draw the surfels that ``cull`` listed, or those of another list."""
        listed = self.visible if listed is None else listed
        if id(listed) not in self._splats:
            self._splats[id(listed)] = self._record_splats(self._surfels, listed)
            self._first_env[id(listed)] = 0
        self._z_buffer.zero_()
        self._sums.zero_()
        self._discs.num_drawn.zero_()
        project, depth, attributes = self._splats[id(listed)]
        if first_env != self._first_env[id(listed)]:
            attributes.set_param_at_index(2, first_env)
            self._first_env[id(listed)] = first_env
        project.launch()
        depth.launch()
        attributes.launch()
        self._resolve.launch()
        return self.view

    def list_hidden(self, hidden: VisibleList) -> None:
        """List the culled surfels that lie well behind the surface that ``splat`` just drew."""
        hidden.count.zero_()
        wp.launch(
            list_hidden,
            dim=(self.envs, self.workers),
            inputs=[self.visible, self.camera, self.workers, self._z_buffer, hidden],
            device=self.device,
        )
