# ruff: noqa: UP018, RUF046
"""Predict the images of many camera poses from the map.

The front surface and the surface behind it are rendered from one reference pose with a wider field
of view (a layered depth image: Shade et al., SIGGRAPH 1998), and their points are warped into all
cameras. They are about one point per pixel of the predicted images, already averaged over the
surfels. Warping them costs a tenth of splatting the surfels into every view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert
from ms_slam_env.slam.surfel.device import threads_per_row
from ms_slam_env.slam.surfel.rendering import (
    ModelView,
    SplatParameters,
    SplatRenderer,
    splat_camera,
)
from ms_slam_env.slam.surfel.surfels import (
    MapBuffers,
    SplatCamera,
    allocate,
    rotation_of,
    translation_of,
)

EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
DEPTH_BINS_PER_M = wp.constant(10.0)  # points in one depth bin compete by distance to the pixel
HIDDEN = wp.constant(wp.int64(1 << 39))  # key bit of points of the second layer
CLOSE_GAP = wp.constant(4)  # an empty pixel with at least this many neighbours is a gap to close


@wp.struct
class PointCloud:
    """Points of E reference views, in the reference camera's frame.

    The first ``front_count`` (E,) of ``count`` (E,) points are on the front surface.
    """

    position: wp.array2d[wp.vec3]
    normal: wp.array2d[wp.vec3]
    intensity: wp.array2d[wp.float32]
    count: wp.array[wp.int32]
    front_count: wp.array[wp.int32]


@wp.kernel
def collect_points(
    vertices: wp.array3d[wp.vec3],
    normals: wp.array3d[wp.vec3],
    intensity: wp.array3d[wp.float32],
    points: PointCloud,
) -> None:
    """Append the surface points of one layer."""
    e, v = wp.tid()
    for u in range(vertices.shape[2]):
        p = vertices[e, v, u]
        if p[2] > 0.0:
            slot = wp.atomic_add(points.count, e, 1)
            points.position[e, slot] = p
            points.normal[e, slot] = normals[e, v, u]
            points.intensity[e, slot] = intensity[e, v, u]


@wp.kernel
def scatter_points(
    points: PointCloud,
    views_per_env: int,
    motions: wp.array[wp.mat44],
    camera: SplatCamera,
    workers: int,
    keys: wp.array[wp.int64],
) -> None:
    """Fill a z-buffer: for each pixel, the smallest key of the points within a pixel of it.

    A key is (depth bin, layer, squared distance to the pixel, point). So among the points of one
    surface the nearest to the pixel wins, and points hidden in the reference view stay hidden.
    ``motions[v]`` is T_view_reference; keys are (V * h * w).
    """
    view, worker = wp.tid()
    e = view / views_per_env
    height = camera.height
    width = camera.width
    image = view * height * width
    K = wp.mat33(
        camera.focal[0], 0.0, camera.centre[0],
        0.0, camera.focal[1], camera.centre[1],
        0.0, 0.0, 1.0,
    )  # fmt: skip
    R = K * rotation_of(motions[view])
    t = K * translation_of(motions[view])
    right = float(width)
    bottom = float(height)
    front_count = points.front_count[e]
    for j in range(worker, points.count[e], workers):
        p = R * points.position[e, j] + t
        z = p[2]
        if z > camera.z_near and p[0] > -z and p[0] < right * z and p[1] > -z and p[1] < bottom * z:
            inverse = 1.0 / z
            u = p[0] * inverse
            v = p[1] * inverse
            u0 = int(u + 1.0) - 1
            v0 = int(v + 1.0) - 1
            du = u - float(u0)
            dv = v - float(v0)
            eu = 1.0 - du
            ev = 1.0 - dv
            key = (wp.int64(int(z * DEPTH_BINS_PER_M)) << wp.int64(40)) + wp.int64(j)
            if j >= front_count:
                key += HIDDEN
            # the division may round up to the border itself: u0 = width or v0 = height
            left_in = u0 >= 0 and u0 < width
            right_in = u0 + 1 < width
            pixel = image + v0 * width + u0
            if v0 >= 0 and v0 < height:
                if left_in:
                    off = wp.int64(int((du * du + dv * dv) * 127.0)) << wp.int64(32)
                    wp.atomic_min(keys, pixel, key + off)
                if right_in:
                    off = wp.int64(int((eu * eu + dv * dv) * 127.0)) << wp.int64(32)
                    wp.atomic_min(keys, pixel + 1, key + off)
            if v0 + 1 < height:
                if left_in:
                    off = wp.int64(int((du * du + ev * ev) * 127.0)) << wp.int64(32)
                    wp.atomic_min(keys, pixel + width, key + off)
                if right_in:
                    off = wp.int64(int((eu * eu + ev * ev) * 127.0)) << wp.int64(32)
                    wp.atomic_min(keys, pixel + width + 1, key + off)


@wp.func
def gap_key(
    keys: wp.array[wp.int64], image: int, v: int, u: int, height: int, width: int
) -> wp.int64:
    """Key of the farthest neighbour of an empty pixel with enough neighbours."""
    found = int(0)
    farthest = wp.int64(-1)
    for y in range(wp.max(v - 1, 0), wp.min(v + 2, height)):
        for x in range(wp.max(u - 1, 0), wp.min(u + 2, width)):
            key = keys[image + y * width + x]
            if key != EMPTY:
                found += 1
                farthest = wp.max(farthest, key)
    if found < CLOSE_GAP:
        return EMPTY
    return farthest


@wp.kernel
def resolve_views(
    points: PointCloud,
    views_per_env: int,
    motions: wp.array[wp.mat44],
    camera: SplatCamera,
    keys: wp.array[wp.int64],
    columns: int,  # per thread
    intensity: wp.array[wp.float32],
    depth: wp.array[wp.float32],
    normals: wp.array[wp.vec3],
) -> None:
    """Write images of the winning points; small gaps take the farthest neighbour, others are 0.

    The depth at a pixel is that of the winner's plane, within a tenth of the winner's own depth.
    """
    view, v, piece = wp.tid()
    e = view / views_per_env
    R = rotation_of(motions[view])
    t = translation_of(motions[view])
    height = camera.height
    width = camera.width
    image = view * height * width
    row = image + v * width
    # Intersect planes in the reference frame, where the points are: n . (p + shift) = z n . ray.
    R_back = wp.transpose(R)
    shift = R_back * t
    across = wp.vec3(R_back[0, 0], R_back[1, 0], R_back[2, 0]) / camera.focal[0]
    first_ray = R_back * wp.vec3(
        -camera.centre[0] / camera.focal[0], (float(v) - camera.centre[1]) / camera.focal[1], 1.0
    )
    forward = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    for u in range(piece * columns, wp.min((piece + 1) * columns, width)):
        key = keys[row + u]
        if key == EMPTY:
            key = gap_key(keys, image, v, u, height, width)
        grey = float(0.0)
        z = float(0.0)
        normal = wp.vec3(0.0, 0.0, 0.0)
        if key != EMPTY:
            j = int(key & wp.int64(0xFFFFFFFF))
            p = points.position[e, j] + shift
            n = points.normal[e, j]
            slope = wp.min(wp.dot(n, first_ray + float(u) * across), -1.0e-6)
            centre_z = wp.dot(forward, p)
            z = wp.clamp(wp.dot(n, p) / slope, 0.9 * centre_z, 1.1 * centre_z)
            grey = points.intensity[e, j]
            normal = R * n
        intensity[row + u] = grey
        depth[row + u] = z
        normals[row + u] = normal


@wp.kernel
def copy_view(
    vertices: wp.array3d[wp.vec3],
    normals_of_view: wp.array3d[wp.vec3],
    intensity_of_view: wp.array3d[wp.float32],
    views_per_env: int,
    n: int,
    intensity: wp.array3d[wp.float32],
    depth: wp.array3d[wp.float32],
    normals: wp.array3d[wp.vec3],
) -> None:
    """Copy the n-th rendered view of every env to its place among the predicted ones."""
    e, v, u = wp.tid()
    view = e * views_per_env + n
    intensity[view, v, u] = intensity_of_view[e, v, u]
    depth[view, v, u] = vertices[e, v, u][2]
    normals[view, v, u] = normals_of_view[e, v, u]


MAX_MARGIN = 1.0  # largest margin of the reference view on each side, in sizes of the views
NEAREST_M = 0.5  # surfaces closer than this may leave the reference view's margin
LAYERS = 8.0  # surfaces of discs drawn in a view that is rendered on its own
SIZE_STEP_PX = 8  # margins are multiples of this, so that few sets of buffers are needed


@dataclass(frozen=True)
class DeviceViews:
    """Predicted images on the device; see ``ms_slam_env.slam.slam_backend.Views``."""

    intensity: wp.array  # (V, h, w) float32 in [0, 255]
    depth: wp.array  # (V, h, w) float32 metres
    normals: wp.array  # (V, h, w) vec3, camera frame
    intrinsics: Intrinsics  # of the images


def mean_pose(poses: Float64) -> Float64:
    """Mean (4, 4) of poses (N, 4, 4): mean position, chordal mean of rotations."""
    U, _, Vt = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    result = np.eye(4)
    result[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    result[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return result


def wide_intrinsics(intrinsics: Intrinsics, motions: Float64) -> Intrinsics | None:
    """Intrinsics of a reference view that covers the views at T_reference_view (V, 4, 4).

    None if this takes more than (1 + 2 MAX_MARGIN) times the size: the views are too far apart.
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

    def __init__(self, renderer: SplatRenderer) -> None:
        self.renderer = renderer
        envs, capacity = renderer.envs, 2 * renderer.intrinsics.width * renderer.intrinsics.height
        device = renderer.device
        self.points = allocate(PointCloud, envs, capacity, device)

    def render(self, poses: wp.array, first_env: int) -> None:
        """Fill ``points`` from the front surface and the one behind it."""
        self.points.count.zero_()
        self.renderer.cull(poses, first_env)
        self._collect(self.renderer.splat(first_env))
        wp.copy(self.points.front_count, self.points.count)
        self._collect(self.renderer.splat_hidden(first_env))

    def _collect(self, layer: ModelView) -> None:
        inputs = [layer.vertices, layer.normals, layer.intensity, self.points]
        dim = (self.renderer.envs, self.renderer.intrinsics.height)
        wp.launch(collect_points, dim, inputs, device=self.renderer.device)


class ViewPredictor:
    """Predicts nearby views by warping one reference view, and distant ones one by one."""

    def __init__(
        self, buffers: MapBuffers, intrinsics: Intrinsics, parameters: SplatParameters
    ) -> None:
        self.intrinsics = intrinsics
        self.parameters = parameters
        self.device = buffers.device
        self.workers = buffers.workers
        self._map = buffers
        self._references: dict[tuple[int, Intrinsics], _Reference] = {}
        self._single: dict[tuple[int, Intrinsics], SplatRenderer] = {}
        self._outputs: dict[tuple[int, Intrinsics], tuple[wp.array, DeviceViews]] = {}

    def predict(
        self, poses: Float64, scale: float, first_env: int, singly: bool = False
    ) -> DeviceViews:
        """Images (E * N, h, w) from ``poses`` (E, N, 4, 4) of E envs, the first ``first_env``.

        With ``singly``, all surfels are splatted into every view.
        """
        if poses.ndim != 4 or poses.shape[2:] != (4, 4) or 0 in poses.shape:
            raise InputError(f"poses must be (envs, views, 4, 4), got {poses.shape}")
        if not np.isfinite(poses).all():
            raise InputError("poses hold a value that is not finite")
        if not 0.0 < scale <= 4.0:
            raise InputError(f"scale = {scale!r} is outside (0, 4]")
        envs, count = poses.shape[:2]
        intrinsics = self.intrinsics.scaled(scale)
        keys, views = self._buffers(envs * count, intrinsics)
        if singly:
            self._predict_singly(poses, views, first_env, math.inf)
            return views
        references = np.stack([mean_pose(poses[e]) for e in range(envs)])
        motions = invert(references)[:, None] @ poses
        wide = wide_intrinsics(intrinsics, motions.reshape(-1, 4, 4))
        if wide is None:
            self._predict_singly(poses, views, first_env, LAYERS)
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
        wp.launch(scatter_points, dim, inputs, device=self.device)
        images = [image.flatten() for image in (views.intensity, views.depth, views.normals)]
        columns, threads = threads_per_row(views.intrinsics.width, self.device)
        pieces = (total, views.intrinsics.height, threads)
        wp.launch(resolve_views, pieces, [*shared, keys, columns, *images], device=self.device)

    def _predict_singly(
        self, poses: Float64, views: DeviceViews, first_env: int, layers: float
    ) -> None:
        """Splat the surfels themselves into every view, one view per env at a time.

        From far away, or in small images, there are dozens of surfels per pixel, so they are
        thinned to about ``layers`` surfaces.
        """
        envs, count = poses.shape[:2]
        key = (envs, views.intrinsics)
        if key not in self._single:
            self._single[key] = self._renderer(envs, views.intrinsics)
        renderer = self._single[key]
        for n in range(count):
            renderer.cull(self._upload(poses[:, n]), first_env, layers=layers)
            image = renderer.splat(first_env)
            drawn = [image.vertices, image.normals, image.intensity]
            inputs = [*drawn, count, n, views.intensity, views.depth, views.normals]
            dim = (envs, *views.intrinsics.shape)
            wp.launch(copy_view, dim, inputs, device=self.device)

    def _upload(self, poses: Float64) -> wp.array:
        """Upload poses (..., 4, 4) float64 as a flat device array of mat44."""
        flat = np.ascontiguousarray(poses.reshape(-1, 4, 4), dtype=np.float32)
        return wp.array(flat, dtype=wp.mat44, device=self.device)

    def _renderer(self, envs: int, intrinsics: Intrinsics) -> SplatRenderer:
        return SplatRenderer(self._map, envs, intrinsics, self.parameters)

    def _reference(self, envs: int, intrinsics: Intrinsics) -> _Reference:
        key = (envs, intrinsics)
        if key not in self._references:
            self._references[key] = _Reference(self._renderer(envs, intrinsics))
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
