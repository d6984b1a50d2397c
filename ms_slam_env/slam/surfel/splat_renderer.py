"""Renders surfel maps: holds the buffers of one image size and runs the splatting kernels."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.splat import (
    FAR,
    cull,
    resolve,
    splat_attributes,
    splat_depth,
)
from ms_slam_env.slam.surfel.surfel_arrays import Surfels, VisibleList
from ms_slam_env.slam.surfel.types import ModelView


@dataclass(frozen=True)
class SplatParameters:
    """How discs are drawn.

    Attributes:
        tolerance_m: discs this far behind the nearest one are averaged with it (at 1 m).
        z_near: nearest depth drawn, metres.
        z_far: farthest depth drawn, metres.
        min_px: smallest drawn radius of a disc, pixels.
        max_px: largest drawn radius of a disc, pixels.
        max_weight: confidence above which a disc weighs no more.
    """

    tolerance_m: float
    z_near: float = 0.05
    z_far: float = 12.0
    min_px: float = 0.6
    max_px: float = 5.0
    max_weight: float = 20.0


def camera_vector(intrinsics: Intrinsics) -> wp.vec4:
    """(fx, fy, cx, cy) as the kernels take it."""
    return wp.vec4(intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)


class SplatRenderer:
    """Renders ``envs`` maps, one pose each, at one image size.

    Args:
        envs: number of images rendered at once.
        intrinsics: of the images.
        parameters: how discs are drawn.
        workers: threads per env; 1 on the CPU, where they would run one after the other.
        device: Warp device.
    """

    def __init__(
        self,
        envs: int,
        intrinsics: Intrinsics,
        parameters: SplatParameters,
        workers: int,
        device: str,
    ) -> None:
        self.envs = envs
        self.intrinsics = intrinsics
        self.parameters = parameters
        self.workers = workers
        self.device = device
        self._camera = camera_vector(intrinsics)
        shape = (envs, *intrinsics.shape)
        self.z_buffer = wp.zeros(shape, dtype=wp.float32, device=device)
        self._no_layer = wp.zeros(shape, dtype=wp.float32, device=device)
        self._normal_sum = wp.zeros(shape, dtype=wp.vec4, device=device)
        self._color_sum = wp.zeros(shape, dtype=wp.vec4, device=device)

    def new_view(self) -> ModelView:
        """Allocate the images that ``render`` fills."""
        shape = (self.envs, *self.intrinsics.shape)
        return ModelView(
            vertices=wp.zeros(shape, dtype=wp.vec3, device=self.device),
            normals=wp.zeros(shape, dtype=wp.vec3, device=self.device),
            intensity=wp.zeros(shape, dtype=wp.float32, device=self.device),
            color=wp.zeros(shape, dtype=wp.vec3, device=self.device),
        )

    def cull(
        self,
        surfels: Surfels,
        poses: wp.array,
        visible: VisibleList,
        first_env: int = 0,
        margin_px: float = 1.0,
    ) -> None:
        """List in ``visible`` the surfels that the cameras at ``poses`` (envs,) can see."""
        visible.count.zero_()
        wp.launch(
            cull,
            dim=(self.envs, self.workers),
            inputs=[
                surfels,
                first_env,
                poses,
                self._camera,
                self.intrinsics.width,
                self.intrinsics.height,
                self.parameters.z_near,
                self.parameters.z_far,
                margin_px,
                self.workers,
                visible,
            ],
            device=self.device,
        )

    def splat(
        self,
        surfels: Surfels,
        visible: VisibleList,
        view: ModelView,
        first_env: int = 0,
        behind: wp.array | None = None,
    ) -> None:
        """Draw the listed surfels into ``view``, or only the surface behind depth ``behind``."""
        p = self.parameters
        z_buffer = self.z_buffer
        z_buffer.fill_(float(FAR))
        self._normal_sum.zero_()
        self._color_sum.zero_()
        wp.launch(
            splat_depth,
            dim=(self.envs, self.workers),
            inputs=[
                surfels,
                visible,
                first_env,
                self._camera,
                p.min_px,
                p.max_px,
                self.workers,
                self._no_layer if behind is None else behind,
                p.tolerance_m,
                z_buffer,
            ],
            device=self.device,
        )
        wp.launch(
            splat_attributes,
            dim=(self.envs, self.workers),
            inputs=[
                surfels,
                visible,
                first_env,
                self._camera,
                p.min_px,
                p.max_px,
                p.max_weight,
                self.workers,
                p.tolerance_m,
                z_buffer,
                self._normal_sum,
                self._color_sum,
            ],
            device=self.device,
        )
        wp.launch(
            resolve,
            dim=(self.envs, self.intrinsics.height),
            inputs=[
                self._normal_sum,
                self._color_sum,
                self._camera,
                view.vertices,
                view.normals,
                view.intensity,
                view.color,
            ],
            device=self.device,
        )
