# mypy: disable-error-code="empty-body"
# ruff: noqa: UP018, RUF046
"""Render surfel maps: footprints, z-buffer, average of the front surface, resolve.

There are two passes over the visible discs: the first finds the nearest surface of every pixel, the
second averages all discs within the depth tolerance behind it (visibility splatting: Botsch et al.,
"High-quality surface splatting on today's GPUs", 2005). The inverse depth of a disc's plane is
linear in the image, so intersecting the viewing ray with the plane costs two multiplications per
pixel. Z-buffers hold inverse depth, 0 where empty.

Launches are (envs, workers): the workers of an env share its list, and the CPU's single worker
keeps the camera in registers. Flat image buffers save most of the address arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.native import native_source
from ms_slam_env.slam.surfel.device import fetch, put, raise_to, threads_per_row
from ms_slam_env.slam.surfel.frustum_culling import FrustumCuller
from ms_slam_env.slam.surfel.surfels import (
    MapBuffers,
    SeenWindow,
    SplatCamera,
    SplatFootprints,
    Surfels,
    VisibleList,
    depth_tolerance,
    floor_int,
)


@wp.func
def half_extent(
    p: wp.vec3, n: wp.vec3, across: float, tilt: float, radius: float, focal: float
) -> float:
    """Extent of a disc at p from its centre, in columns or rows.

    A tilted disc is an ellipse: an offset d in its plane moves the column by (f / z) a . d with
    a = (1, 0, -x / z), at most |d| times a's component in the plane. ``across`` is x or y, ``tilt``
    the normal's component along it. An extra 5 % allows for perspective.
    """
    ratio = across / p[2]
    part = tilt - ratio * n[2]
    in_plane = wp.sqrt(wp.max(1.0 + ratio * ratio - part * part, 0.0))
    return 1.05 * focal * radius / p[2] * in_plane


@wp.func
def drawn_radius(radius: float, z: float, camera: SplatCamera) -> float:
    """Radius in metres, clamped to the limits in pixels."""
    pixel = z / camera.focal[0]
    return wp.clamp(radius, camera.min_px * pixel, camera.max_px * pixel)


@wp.kernel
def project_footprints(
    visible: VisibleList, camera: SplatCamera, workers: int, footprints: SplatFootprints
) -> None:
    """Compute the footprints of the listed surfels.

    Several short loops without branches: the compiler turns them into operations on many surfels
    at once, which it does not for loops that write many arrays. Of many workers each takes one
    surfel at a time, so that neighbours fetch and write neighbours.
    """
    k, worker = wp.tid()
    fx = camera.focal[0]
    fy = camera.focal[1]
    cx = camera.centre[0]
    cy = camera.centre[1]
    count = visible.count[k]
    start = int(worker)
    while start < count:
        end = wp.where(workers == 1, count, start + 1)
        j = int(start)
        while j < end:
            p = fetch(visible.position, k, j)
            inverse = 1.0 / p[2]
            put(footprints.inverse, k, j, inverse)
            put(footprints.u, k, j, fx * p[0] * inverse + cx)
            put(footprints.v, k, j, fy * p[1] * inverse + cy)
            j += 1
        j = int(start)
        while j < end:
            n = fetch(visible.normal, k, j)
            # n . ray = (n . p) / z for rays with z = 1: inverse depth is (n / (n . p)) . ray.
            plane = 1.0 / wp.min(wp.dot(n, fetch(visible.position, k, j)), -1.0e-6)
            put(footprints.slope_u, k, j, n[0] * plane / fx)
            put(footprints.slope_v, k, j, n[1] * plane / fy)
            j += 1
        j = int(start)
        while j < end:
            z = fetch(visible.position, k, j)[2]
            radius = drawn_radius(fetch(visible.radius, k, j), z, camera)
            put(footprints.rim, k, j, radius * radius)
            j += 1
        j = int(start)
        while j < end:
            p = fetch(visible.position, k, j)
            n = fetch(visible.normal, k, j)
            radius = drawn_radius(fetch(visible.radius, k, j), p[2], camera)
            reach = half_extent(p, n, p[0], n[0], radius, fx)
            u = fx * p[0] / p[2] + cx
            put(footprints.left, k, j, wp.max(floor_int(u - reach) + 1, 0))
            put(footprints.right, k, j, wp.min(floor_int(u + reach), camera.width - 1))
            j += 1
        j = int(start)
        while j < end:
            p = fetch(visible.position, k, j)
            n = fetch(visible.normal, k, j)
            radius = drawn_radius(fetch(visible.radius, k, j), p[2], camera)
            reach = half_extent(p, n, p[1], n[1], radius, fy)
            v = fy * p[1] / p[2] + cy
            put(footprints.top, k, j, wp.max(floor_int(v - reach) + 1, 0))
            put(footprints.bottom, k, j, wp.min(floor_int(v + reach), camera.height - 1))
            j += 1
        start += wp.where(workers == 1, count, workers)


Sums: Any = wp.types.vector(length=8, dtype=wp.float32)
"""Weighted sums of a pixel: normal (3), weight, colour (3), depth."""


@wp.func
def squared_offset(x: float, y: float, z: float, inverse_offset: float) -> float:
    """Squared distance (m2) of a point in a disc's plane from the disc's centre at depth z.

    The point differs from the centre by x, y (m) and an inverse depth. The distance is exact to
    first order in the offset; the error only moves the disc's rim, by less than its perspective.
    """
    away = z * z * inverse_offset
    return x * x + y * y + away * away


@wp.kernel
def splat_depth(
    visible: VisibleList,
    camera: SplatCamera,
    workers: int,
    footprints: SplatFootprints,
    z_buffer: wp.array[wp.float32],
) -> None:
    """Inverse depth (E * H * W) of the nearest disc at every pixel; list the discs on a pixel.

    Many workers leave a gap, -1, where a disc is on none: a counter would be in great demand.
    """
    k, worker = wp.tid()
    width = camera.width
    image = k * camera.height * width
    count = visible.count[k]
    j = int(worker)
    if workers > 1 and worker == 0:
        footprints.num_drawn[k] = count
    while j < count:
        left = fetch(footprints.left, k, j)
        right = fetch(footprints.right, k, j)
        row = fetch(footprints.top, k, j)
        bottom = fetch(footprints.bottom, k, j)
        hits = int(0)
        if left <= right and row <= bottom:
            centre_u = fetch(footprints.u, k, j)
            centre_v = fetch(footprints.v, k, j)
            centre_inverse = fetch(footprints.inverse, k, j)
            slope_u = fetch(footprints.slope_u, k, j)
            slope_v = fetch(footprints.slope_v, k, j)
            rim = fetch(footprints.rim, k, j)
            nearly_rim = rim * 1.00001  # ``splat_attributes`` rounds otherwise
            z = 1.0 / centre_inverse
            pixel_u = z / camera.focal[0]
            pixel_v = z / camera.focal[1]
            while row <= bottom:
                dv = float(row) - centre_v
                u = int(left)
                while u <= right:
                    du = float(u) - centre_u
                    offset = du * slope_u + dv * slope_v
                    squared = squared_offset(du * pixel_u, dv * pixel_v, z, offset)
                    hits += wp.where(squared <= nearly_rim, 1, 0)
                    inverse = wp.where(squared <= rim, centre_inverse + offset, 0.0)
                    raise_to(z_buffer, image + row * width + u, inverse)
                    u += 1
                row += 1
        if workers > 1:
            put(footprints.drawn, k, j, wp.where(hits > 0, j, -1))
        elif hits > 0:
            put(footprints.drawn, k, wp.atomic_add(footprints.num_drawn, k, 1), j)
        j += workers


@wp.kernel
def splat_attributes(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: SplatCamera,
    workers: int,
    footprints: SplatFootprints,
    z_buffer: wp.array[wp.float32],
    sums: wp.array[Sums],
) -> None:
    """Sum the discs of the front surface at every pixel.

    Their weight is the confidence, at most ``max_weight``, and falls off towards the disc's rim.
    """
    k, worker = wp.tid()
    b = first_env + k
    width = camera.width
    image = k * camera.height * width
    count = footprints.num_drawn[k]
    d = int(worker)
    while d < count:
        drawn = fetch(footprints.drawn, k, d)
        j = wp.max(drawn, 0)
        left = fetch(footprints.left, k, j)
        right = fetch(footprints.right, k, j)
        row = fetch(footprints.top, k, j)
        bottom = wp.where(drawn < 0, row - 1, fetch(footprints.bottom, k, j))
        centre_u = fetch(footprints.u, k, j)
        centre_v = fetch(footprints.v, k, j)
        centre_inverse = fetch(footprints.inverse, k, j)
        slope_u = fetch(footprints.slope_u, k, j)
        slope_v = fetch(footprints.slope_v, k, j)
        per_rim = 1.0 / fetch(footprints.rim, k, j)
        n = fetch(visible.normal, k, j)
        i = fetch(visible.index, k, j)
        color = fetch(surfels.color, b, i)
        confidence = wp.min(fetch(surfels.confidence, b, i), camera.max_weight)
        z = 1.0 / centre_inverse
        pixel_u = z / camera.focal[0]
        pixel_v = z / camera.focal[1]
        # Same surface: z < front + tolerance. To first order in inverse depth.
        reach = depth_tolerance(camera.tolerance_m, z) * centre_inverse * centre_inverse
        while row <= bottom:
            dv = float(row) - centre_v
            u = int(left)
            while u <= right:
                du = float(u) - centre_u
                offset = du * slope_u + dv * slope_v
                inverse = centre_inverse + offset
                share = squared_offset(du * pixel_u, dv * pixel_v, z, offset) * per_rim
                pixel = image + row * width + u
                if share <= 1.0 and inverse >= fetch(z_buffer, pixel) - reach:
                    w = confidence * (1.05 - share)
                    sample = Sums(
                        n[0], n[1], n[2], 1.0, color[0], color[1], color[2], 1.0 / inverse
                    )
                    wp.atomic_add(sums, pixel, w * sample)
                u += 1
            row += 1
        d += workers


@wp.kernel
def leave_hidden(
    visible: VisibleList,
    camera: SplatCamera,
    workers: int,
    z_buffer: wp.array[wp.float32],
    footprints: SplatFootprints,
) -> None:
    """Leave only the surfels to draw that lie well behind the front surface at their own pixel."""
    k, worker = wp.tid()
    image = k * camera.height * camera.width
    for j in range(worker, visible.count[k], workers):
        p = visible.position[k, j]
        u = floor_int(camera.focal[0] * p[0] / p[2] + camera.centre[0] + 0.5)
        v = floor_int(camera.focal[1] * p[1] / p[2] + camera.centre[1] + 0.5)
        is_hidden = bool(False)
        if u >= 0 and u < camera.width and v >= 0 and v < camera.height:
            inverse = z_buffer[image + v * camera.width + u]
            if inverse > 0.0:
                front = 1.0 / inverse
                is_hidden = p[2] > front + 2.0 * depth_tolerance(camera.tolerance_m, front)
        if not is_hidden:
            footprints.right[k, j] = -1  # before the first column


@wp.func_native(native_source("splatting", "resolve_row"))
def resolve_row(
    sums: wp.array[Sums],
    camera: SplatCamera,
    y: float,
    first: int,
    start: int,
    end: int,
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    intensity: wp.array[wp.float32],
    color: wp.array[wp.vec3],
) -> None:
    """Resolve columns of the row from pixel ``first`` on, whose rays have ``y`` at z = 1."""


@wp.kernel
def resolve(
    sums: wp.array[Sums],
    camera: SplatCamera,
    columns: int,  # per thread
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    intensity: wp.array[wp.float32],
    color: wp.array[wp.vec3],
) -> None:
    """Divide the sums by their weights; pixels that no disc covers become 0."""
    k, v, piece = wp.tid()
    y = (float(v) - camera.centre[1]) / camera.focal[1]
    first = (k * camera.height + v) * camera.width
    start = piece * columns
    end = wp.min(start + columns, camera.width)
    resolve_row(sums, camera, y, first, start, end, vertices, normals, intensity, color)


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
    """Build the camera struct for the kernels."""
    camera = SplatCamera()
    camera.width, camera.height = intrinsics.width, intrinsics.height
    camera.focal = wp.vec2(intrinsics.fx, intrinsics.fy)
    camera.centre = wp.vec2(intrinsics.cx, intrinsics.cy)
    for name, value in vars(parameters).items():
        setattr(camera, name, value)
    return camera


class SplatRenderer:
    """Renders ``envs`` of the maps in ``buffers``, one pose each, at one image size.

    Launches are recorded once; a recorded launch costs a fifth of one that packs its arguments.

    ``splat`` overwrites ``view``. ``cull`` fills ``visible``, which all renderers of the map share.
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
        self._sums = wp.zeros(pixels, dtype=Sums, device=self.device)
        self._culler = FrustumCuller(buffers, envs, self.camera, window)
        self._splats: dict[int, list[RecordedLaunch]] = {}
        images = [a.flatten() for a in (view.vertices, view.normals, view.intensity, view.color)]
        columns, threads = threads_per_row(intrinsics.width, self.device)
        dim, inputs = (
            (envs, intrinsics.height, threads),
            [self._sums, self.camera, columns, *images],
        )
        self._resolve = RecordedLaunch(resolve, dim, inputs, self.device)

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

        If there are many discs per pixel, they are thinned to about ``layers`` surfaces.
        """
        self._culler(poses, first_env, margin_px, layers)

    def splat(self, first_env: int = 0) -> ModelView:
        """Draw the surfels that ``cull`` listed."""
        return self._draw(first_env, 0)

    def splat_hidden(self, first_env: int = 0) -> ModelView:
        """Draw those of them that lie well behind the surface that ``splat`` just drew."""
        inputs = [self.visible, self.camera, self._buffers.workers, self._z_buffer]
        dim = (self.envs, self._buffers.workers)
        wp.launch(leave_hidden, dim, [*inputs, self._buffers.footprints], device=self.device)
        return self._draw(first_env, 1)

    def _draw(self, first_env: int, first_pass: int) -> ModelView:
        """Make the passes over the listed surfels from one of them on."""
        self._z_buffer.zero_()
        self._sums.zero_()
        self._buffers.footprints.num_drawn.zero_()
        if first_env not in self._splats:
            self._splats[first_env] = self._record_splats(first_env)
        for launch in (*self._splats[first_env][first_pass:], self._resolve):
            launch.launch()
        return self.view

    def _record_splats(self, first_env: int) -> list[RecordedLaunch]:
        """The three passes over the listed surfels."""
        surfels, workers = self._buffers.surfels, self._buffers.workers
        shared = [self.visible, self.camera, workers, self._buffers.footprints]
        listed_in = [surfels, self.visible, first_env, *shared[1:]]
        passes = (
            (project_footprints, shared),
            (splat_depth, [*shared, self._z_buffer]),
            (splat_attributes, [*listed_in, self._z_buffer, self._sums]),
        )
        dim = (self.envs, workers)
        return [RecordedLaunch(kernel, dim, inputs, self.device) for kernel, inputs in passes]
