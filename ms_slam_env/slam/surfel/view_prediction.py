"""Predicts the images of many camera poses from the map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel import view_warping
from ms_slam_env.slam.surfel.rendering import (
    ModelView,
    SplatParameters,
    SplatRenderer,
    splat_camera,
)
from ms_slam_env.slam.surfel.surfels import MapBuffers, VisibleList, allocate
from ms_slam_env.slam.surfel.view_warping import EMPTY, PointCloud

MAX_MARGIN = 1.0  # a reference view wider than the views by more than their own size is refused
NEAREST_M = 0.5  # surfaces closer than this may leave the reference view's margin
LAYERS = 8.0  # surfaces of discs that are drawn in a view of its own
SIZE_STEP_PX = 8  # reference views come in such steps, so that few sets of buffers are needed


@dataclass(frozen=True)
class DeviceViews:
    """Predicted images on the device; see ``ms_slam_env.slam.slam_backend.Views``."""

    intensity: wp.array  # (V, h, w) float32 in [0, 255]
    depth: wp.array  # (V, h, w) float32 metres
    normals: wp.array  # (V, h, w) vec3, camera frame
    intrinsics: Intrinsics  # of the images


def mean_pose(poses: Float64) -> Float64:
    """Pose (4, 4) in the middle of poses (N, 4, 4): mean position, chordal mean of rotations."""
    U, _, Vt = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    result = np.eye(4)
    result[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    result[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return result


def wide_intrinsics(intrinsics: Intrinsics, motions: Float64) -> Intrinsics | None:
    """Intrinsics of a reference view that sees what views at T_reference_view (V, 4, 4) see.

    None if no image of at most (1 + 2 MAX_MARGIN) times the size does: the views are too far apart.
    """
    w, h = intrinsics.width, intrinsics.height
    rays = intrinsics.rays_at([[u, v] for v in (-0.5, h - 0.5) for u in (-0.5, w - 0.5)])
    corners = np.einsum("vij,cj->vci", motions[:, :3, :3], rays)
    if corners[..., 2].min() < 0.2:
        return None
    pixels = intrinsics.project(corners)
    parallax = np.linalg.norm(motions[:, :3, 3], axis=1).max() * intrinsics.fx / NEAREST_M
    limits = ((pixels[..., 0], w), (pixels[..., 1], h))
    margins = []
    for coordinate, size in limits:
        beyond = max(-0.5 - coordinate.min(), coordinate.max() - (size - 0.5), 0.0) + parallax
        if beyond > MAX_MARGIN * size:
            return None
        margins.append(SIZE_STEP_PX * math.ceil(beyond / SIZE_STEP_PX))
    left, top = margins
    centre = intrinsics.cx + left, intrinsics.cy + top
    return Intrinsics(intrinsics.fx, intrinsics.fy, *centre, w + 2 * left, h + 2 * top)


class _Reference:
    """Two rendered layers of E maps at one image size, and the points in them."""

    def __init__(self, renderer: SplatRenderer, hidden: VisibleList) -> None:
        self.renderer = renderer
        self.hidden = hidden
        envs, capacity = renderer.envs, 2 * renderer.intrinsics.width * renderer.intrinsics.height
        device = renderer.device
        self.points = allocate(PointCloud, envs, capacity, device)

    def render(self, poses: wp.array, first_env: int) -> None:
        """Fill ``points`` from the front surface and the one behind it."""
        self.points.count.zero_()
        self.renderer.cull(poses, first_env)
        self._collect(self.renderer.splat(first_env))
        wp.copy(self.points.front_count, self.points.count)
        self.renderer.list_hidden(self.hidden)
        self._collect(self.renderer.splat(first_env, self.hidden))

    def _collect(self, layer: ModelView) -> None:
        inputs = [layer.vertices, layer.normals, layer.intensity, self.points]
        dim = (self.renderer.envs, self.renderer.intrinsics.height)
        wp.launch(view_warping.collect_points, dim, inputs, device=self.renderer.device)


class ViewPredictor:
    """Predicts views near each other by warping one reference view; far ones one by one."""

    def __init__(
        self, buffers: MapBuffers, intrinsics: Intrinsics, parameters: SplatParameters
    ) -> None:
        self.intrinsics = intrinsics
        self.parameters = parameters
        self.device = buffers.device
        self.workers = buffers.workers
        self._map = buffers
        self._hidden = allocate(VisibleList, buffers.batch, buffers.capacity, self.device)
        self._references: dict[tuple[int, Intrinsics], _Reference] = {}
        self._single: dict[tuple[int, Intrinsics], SplatRenderer] = {}
        self._outputs: dict[tuple[int, Intrinsics], tuple[wp.array, DeviceViews]] = {}

    def predict(self, poses: Float64, scale: float, first_env: int) -> DeviceViews:
        """Images (E * N, h, w) from ``poses`` (E, N, 4, 4) of the envs from ``first_env`` on."""
        if poses.ndim != 4 or poses.shape[2:] != (4, 4) or 0 in poses.shape:
            raise InputError(f"poses must be (envs, views, 4, 4), got {poses.shape}")
        if not np.isfinite(poses).all():
            raise InputError("poses hold a value that is not finite")
        if not 0.0 < scale <= 4.0:
            raise InputError(f"scale = {scale!r} is outside (0, 4]")
        envs, count = poses.shape[:2]
        intrinsics = self.intrinsics.scaled(scale)
        keys, views = self._buffers(envs * count, intrinsics)
        references = np.stack([mean_pose(poses[e]) for e in range(envs)])
        motions = invert(references)[:, None] @ poses
        wide = wide_intrinsics(intrinsics, motions.reshape(-1, 4, 4))
        if wide is None:
            self._predict_singly(poses, views, first_env)
            return views
        reference = self._reference(envs, wide)
        reference.render(self._upload(references), first_env)
        self._warp(reference.points, count, self._upload(invert(motions)), keys, views)
        return views

    def _warp(
        self, points: PointCloud, count: int, motions: wp.array, keys: wp.array, views: DeviceViews
    ) -> None:
        """Scatter the points into all views and fill in the images."""
        camera = splat_camera(views.intrinsics, self.parameters)
        total = views.depth.shape[0]
        keys.fill_(int(EMPTY))
        shared = [points, count, motions, camera]
        dim, inputs = (total, self.workers), [*shared, self.workers, keys]
        wp.launch(view_warping.scatter_points, dim, inputs, device=self.device)
        images = [image.flatten() for image in (views.intensity, views.depth, views.normals)]
        dim, inputs = (total, views.intrinsics.height), [*shared, keys, *images]
        wp.launch(view_warping.resolve_views, dim, inputs, device=self.device)

    def _predict_singly(self, poses: Float64, views: DeviceViews, first_env: int) -> None:
        """Splat the surfels themselves into every view, one view per env at a time.

        Seen from far away, or in small images, there are dozens to a pixel: so many are left out
        that some are left.
        """
        envs, count = poses.shape[:2]
        key = (envs, views.intrinsics)
        if key not in self._single:
            self._single[key] = self._renderer(envs, views.intrinsics)
        renderer = self._single[key]
        for n in range(count):
            renderer.cull(self._upload(poses[:, n]), first_env, layers=LAYERS)
            image = renderer.splat(first_env)
            drawn = [image.vertices, image.normals, image.intensity]
            inputs = [*drawn, count, n, views.intensity, views.depth, views.normals]
            dim = (envs, *views.intrinsics.shape)
            wp.launch(view_warping.copy_view, dim, inputs, device=self.device)

    def _upload(self, poses: Float64) -> wp.array:
        """(..., 4, 4) float64 as a flat device array of mat44."""
        flat = np.ascontiguousarray(poses.reshape(-1, 4, 4), dtype=np.float32)
        return wp.array(flat, dtype=wp.mat44, device=self.device)

    def _renderer(self, envs: int, intrinsics: Intrinsics) -> SplatRenderer:
        return SplatRenderer(self._map, envs, intrinsics, self.parameters)

    def _reference(self, envs: int, intrinsics: Intrinsics) -> _Reference:
        key = (envs, intrinsics)
        if key not in self._references:
            self._references[key] = _Reference(self._renderer(envs, intrinsics), self._hidden)
        return self._references[key]

    def _buffers(self, count: int, intrinsics: Intrinsics) -> tuple[wp.array, DeviceViews]:
        key = (count, intrinsics)
        if key not in self._outputs:
            shape = (count, *intrinsics.shape)
            dtypes = (wp.float32, wp.float32, wp.vec3)
            grey, depth, normals = (wp.zeros(shape, dtype=t, device=self.device) for t in dtypes)
            views = DeviceViews(grey, depth, normals, intrinsics)
            keys = wp.zeros(math.prod(shape), dtype=wp.int64, device=self.device)
            self._outputs[key] = (keys, views)
        return self._outputs[key]
