"""From sensor images to filtered depth, vertices, normals and intensity, for B envs at once.

ElasticFusion (Whelan et al., RSS 2015) section III: depth is filtered bilaterally. Here the
filter works on inverse depth, because the inverse depth of a plane is linear in the image (so a
symmetric window keeps planes) and the noise of a structured-light sensor is uniform in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.types import LiveFrame


@wp.kernel
def _filter_depth(
    raw_depth: wp.array3d(dtype=wp.float32),
    raw_color: wp.array4d(dtype=wp.uint8),
    spatial_weights: wp.array2d(dtype=wp.float32),
    cutoff_m: wp.float32,
    range_cutoff: wp.float32,  # per metre; differences of inverse depth beyond it weigh nothing
    radius: wp.int32,
    focal: wp.vec2,
    centre: wp.vec2,
    depth: wp.array3d(dtype=wp.float32),
    vertices: wp.array3d(dtype=wp.vec3),
    color: wp.array3d(dtype=wp.vec3),
    intensity: wp.array3d(dtype=wp.float32),
):
    b, v, u = wp.tid()
    height = raw_depth.shape[1]
    width = raw_depth.shape[2]
    rgb = wp.vec3(
        wp.float32(raw_color[b, v, u, 0]),
        wp.float32(raw_color[b, v, u, 1]),
        wp.float32(raw_color[b, v, u, 2]),
    )
    color[b, v, u] = rgb
    intensity[b, v, u] = 0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]
    z = raw_depth[b, v, u]
    if z <= 0.0 or z > cutoff_m:
        depth[b, v, u] = 0.0
        vertices[b, v, u] = wp.vec3(0.0, 0.0, 0.0)
        return
    inverse = 1.0 / z
    scale = 1.0 / (range_cutoff * range_cutoff)
    weight_sum = float(0.0)
    difference_sum = float(0.0)
    for row in range(wp.max(v - radius, 0), wp.min(v + radius + 1, height)):
        for column in range(wp.max(u - radius, 0), wp.min(u + radius + 1, width)):
            z_near = raw_depth[b, row, column]
            if z_near > 0.0 and z_near <= cutoff_m:
                difference = 1.0 / z_near - inverse
                # Tukey's bisquare has the curvature of the Gaussian at 0 and needs no exp().
                closeness = 1.0 - difference * difference * scale
                if closeness > 0.0:
                    weight = (
                        spatial_weights[row - v + radius, column - u + radius]
                        * closeness
                        * closeness
                    )
                    weight_sum += weight
                    difference_sum += weight * difference
    filtered = 1.0 / (inverse + difference_sum / weight_sum)
    depth[b, v, u] = filtered
    vertices[b, v, u] = wp.vec3(
        (float(u) - centre[0]) / focal[0] * filtered,
        (float(v) - centre[1]) / focal[1] * filtered,
        filtered,
    )


@wp.func
def _slope(before: float, here: float, after: float, step: float, largest: float):
    """Derivative of inverse depth from valid neighbours; (slope, 1) or (0, 0) without any.

    Inputs are depths, 0 where invalid. A side that jumps by more than ``largest`` is an edge.
    """
    total = float(0.0)
    count = float(0.0)
    if after > 0.0:
        forward = 1.0 / after - 1.0 / here
        if wp.abs(forward) <= largest:
            total += forward
            count += 1.0
    if before > 0.0:
        backward = 1.0 / here - 1.0 / before
        if wp.abs(backward) <= largest:
            total += backward
            count += 1.0
    if count == 0.0:
        return wp.vec2(0.0, 0.0)
    return wp.vec2(total / (count * step), 1.0)


@wp.kernel
def _normals_from_depth(
    depth: wp.array3d(dtype=wp.float32),
    step: wp.int32,
    largest: wp.float32,
    focal: wp.vec2,
    centre: wp.vec2,
    normals: wp.array3d(dtype=wp.vec3),
):
    b, v, u = wp.tid()
    height = depth.shape[1]
    width = depth.shape[2]
    z = depth[b, v, u]
    normal = wp.vec3(0.0, 0.0, 0.0)
    if z > 0.0:
        left = float(0.0)
        right = float(0.0)
        above = float(0.0)
        below = float(0.0)
        if u >= step:
            left = depth[b, v, u - step]
        if u + step < width:
            right = depth[b, v, u + step]
        if v >= step:
            above = depth[b, v - step, u]
        if v + step < height:
            below = depth[b, v + step, u]
        slope_u = _slope(left, z, right, float(step), largest)
        slope_v = _slope(above, z, below, float(step), largest)
        if slope_u[1] > 0.0 and slope_v[1] > 0.0:
            # n . (x', y', 1) = d / z on a plane n . p = d, with x' = (u - cx) / fx: the gradient
            # of inverse depth in normalised coordinates is the normal up to scale.
            a = slope_u[0] * focal[0]
            c = slope_v[0] * focal[1]
            rest = 1.0 / z - a * (float(u) - centre[0]) / focal[0]
            rest -= c * (float(v) - centre[1]) / focal[1]
            normal = -wp.normalize(wp.vec3(a, c, rest))
    normals[b, v, u] = normal


class Preprocessor:
    """Owns the device buffers of the live frames and fills them."""

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str = "cpu"
    ) -> None:
        """Allocate for ``batch`` envs that share one camera model."""
        self.intrinsics = intrinsics
        self.config = config
        self.device = device
        shape = (batch, *intrinsics.shape)
        self._raw_color = wp.zeros((*shape, 3), dtype=wp.uint8, device=device)
        self.frame = LiveFrame(
            raw_depth=wp.zeros(shape, dtype=wp.float32, device=device),
            depth=wp.zeros(shape, dtype=wp.float32, device=device),
            vertices=wp.zeros(shape, dtype=wp.vec3, device=device),
            normals=wp.zeros(shape, dtype=wp.vec3, device=device),
            color=wp.zeros(shape, dtype=wp.vec3, device=device),
            intensity=wp.zeros(shape, dtype=wp.float32, device=device),
        )
        radius = config.bilateral_radius_px
        offsets = np.arange(-radius, radius + 1, dtype=np.float32)
        squared = offsets[:, None] ** 2 + offsets[None, :] ** 2
        weights = np.exp(-squared / (2 * config.bilateral_sigma_px**2)).astype(np.float32)
        self._spatial_weights = wp.array(weights, dtype=wp.float32, device=device)
        # A finer image has noisier slopes over one pixel; keep the baseline of 160 columns.
        self._normal_step = max(1, intrinsics.width // 160)

    def __call__(self, color: NDArray[np.uint8], depth: NDArray[np.float32]) -> LiveFrame:
        """Preprocess colour (B, H, W, 3) uint8 and depth (B, H, W) float32 m into one LiveFrame.

        The frame's buffers are those of the last call.
        """
        frame, config, camera = self.frame, self.config, self.intrinsics
        self._raw_color.assign(color)
        frame.raw_depth.assign(depth)
        focal, centre = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
        wp.launch(
            _filter_depth,
            dim=frame.depth.shape,
            inputs=[
                frame.raw_depth,
                self._raw_color,
                self._spatial_weights,
                config.depth_cutoff_m,
                2.0 * config.bilateral_sigma_m,
                config.bilateral_radius_px,
                focal,
                centre,
            ],
            outputs=[frame.depth, frame.vertices, frame.color, frame.intensity],
            device=self.device,
        )
        wp.launch(
            _normals_from_depth,
            dim=frame.depth.shape,
            inputs=[
                frame.depth,
                self._normal_step,
                config.normal_edge_per_m * self._normal_step * 160 / camera.width,
                focal,
                centre,
            ],
            outputs=[frame.normals],
            device=self.device,
        )
        return frame
