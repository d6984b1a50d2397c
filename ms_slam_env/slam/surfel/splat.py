"""Kernels that render surfels: cull, z-buffer of discs, average of the front surface, resolve.

Two passes over the visible discs: the first finds the nearest surface of every pixel, the second
averages all discs within the depth tolerance behind it (the visibility splatting of Botsch et al.,
"High-quality surface splatting on today's GPUs", 2005). The inverse depth of a disc's plane is
linear in the image, so the depth at a pixel is that of the viewing ray's intersection with the
plane, at the cost of two multiplications; z-buffers hold inverse depth, 0 where empty.

Launches are (envs, workers): the workers of an env share its list, and the CPU's single worker
keeps the camera in registers. Image buffers are flat, which saves most of their address
arithmetic.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.memory import fetch, put, raise_to
from ms_slam_env.slam.surfel.surfel_arrays import (
    Surfels,
    VisibleList,
    depth_tolerance,
    rotation_of,
    translation_of,
)

Sums = wp.types.vector(length=8, dtype=wp.float32)
"""Weighted sums of a pixel: normal (3), weight, colour (3), depth."""


@wp.struct
class SplatCamera:
    """Image size, focal lengths (px), principal point (px), and how discs are drawn.

    Attributes:
        width: columns.
        height: rows.
        focal: (fx, fy).
        centre: (cx, cy).
        z_near: nearest depth drawn, metres.
        z_far: farthest depth drawn, metres.
        tolerance_m: discs this far behind the nearest one belong to the same surface (at 1 m).
        min_px: smallest drawn radius.
        max_px: largest drawn radius.
        max_weight: confidence above which a disc weighs no more.
    """

    width: int
    height: int
    focal: wp.vec2
    centre: wp.vec2
    z_near: float
    z_far: float
    tolerance_m: float
    min_px: float
    max_px: float
    max_weight: float


@wp.struct
class Disc:
    """A surfel in the image.

    Attributes:
        u: column of its centre.
        v: row of its centre.
        z: depth of its centre.
        inverse: inverse depth of its centre.
        slope_u: change of inverse depth per column.
        slope_v: change of inverse depth per row.
        rim: squared radius, square metres.
        pixel: side of a pixel at its depth, metres (columns, rows).
        low: first column and row that it may cover.
        high: last column and row that it may cover.
    """

    u: float
    v: float
    z: float
    inverse: float
    slope_u: float
    slope_v: float
    rim: float
    pixel: wp.vec2
    low: wp.vec2i
    high: wp.vec2i


@wp.kernel
def cull(
    surfels: Surfels,
    first_env: int,
    poses: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    margin_px: float,
    workers: int,
    visible: VisibleList,
) -> None:
    """List the living surfels in front of the camera, facing it, within its frustum.

    ``poses[k]`` is T_world_camera of env ``first_env + k``.
    """
    k, worker = wp.tid()
    b = first_env + k
    R = wp.transpose(rotation_of(poses[k]))
    t = -(R * translation_of(poses[k]))
    low_u = (-0.5 - margin_px - camera.centre[0]) / camera.focal[0]
    high_u = (float(camera.width) - 0.5 + margin_px - camera.centre[0]) / camera.focal[0]
    low_v = (-0.5 - margin_px - camera.centre[1]) / camera.focal[1]
    high_v = (float(camera.height) - 0.5 + margin_px - camera.centre[1]) / camera.focal[1]
    z_near = camera.z_near
    z_far = camera.z_far
    forward = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    count = surfels.count[b]
    i = int(worker)
    while i < count:
        world = fetch(surfels.position, b, i)
        z = wp.dot(forward, world) + t[2]
        if z > z_near and z < z_far:
            p = R * world + t
            if p[0] > low_u * z and p[0] < high_u * z and p[1] > low_v * z and p[1] < high_v * z:
                n = R * fetch(surfels.normal, b, i)
                if wp.dot(n, p) < 0.0 and fetch(surfels.confidence, b, i) > 0.0:
                    slot = wp.atomic_add(visible.count, k, 1)
                    put(visible.index, k, slot, i)
                    put(visible.position, k, slot, p)
                    put(visible.normal, k, slot, n)
        i += workers


@wp.func
def floor_int(x: float) -> int:
    """Largest integer not above x >= -100; truncation is much faster than ``wp.floor``."""
    return int(x + 100.0) - 100


@wp.func
def project_disc(p: wp.vec3, n: wp.vec3, radius: float, camera: SplatCamera) -> Disc:
    """Footprint of a surfel at p (camera frame) with normal n."""
    disc = Disc()
    inverse = 1.0 / p[2]
    pixel = wp.vec2(p[2] / camera.focal[0], p[2] / camera.focal[1])
    drawn = wp.clamp(radius, camera.min_px * pixel[0], camera.max_px * pixel[0])
    # A tilted disc is an ellipse: an offset d in its plane moves the column by (f / z) a . d with
    # a = (1, 0, -x / z), at most |d| times a's part in the plane. The rest allows for perspective.
    x = p[0] * inverse
    y = p[1] * inverse
    part_u = n[0] - x * n[2]
    part_v = n[1] - y * n[2]
    reach_u = 1.05 * (drawn / pixel[0]) * wp.sqrt(1.0 + x * x - part_u * part_u)
    reach_v = 1.05 * (drawn / pixel[1]) * wp.sqrt(1.0 + y * y - part_v * part_v)
    u = camera.focal[0] * x + camera.centre[0]
    v = camera.focal[1] * y + camera.centre[1]
    # n . ray = (n . p) / z for rays with z = 1, so the inverse depth is (n / (n . p)) . ray.
    plane = 1.0 / wp.min(wp.dot(n, p), -1.0e-6)
    disc.u = u
    disc.v = v
    disc.z = p[2]
    disc.inverse = inverse
    disc.slope_u = n[0] * plane / camera.focal[0]
    disc.slope_v = n[1] * plane / camera.focal[1]
    disc.rim = drawn * drawn
    disc.pixel = pixel
    disc.low = wp.vec2i(
        wp.max(floor_int(u - reach_u) + 1, 0), wp.max(floor_int(v - reach_v) + 1, 0)
    )
    disc.high = wp.vec2i(
        wp.min(floor_int(u + reach_u), camera.width - 1),
        wp.min(floor_int(v + reach_v), camera.height - 1),
    )
    return disc


@wp.func
def squared_offset(disc: Disc, du: float, dv: float, inverse: float) -> float:
    """Squared distance (m2) from the disc's centre of its plane's point at pixel (u+du, v+dv).

    To first order in the offset: only the disc's rim moves, by less than its perspective.
    """
    x = du * disc.pixel[0]
    y = dv * disc.pixel[1]
    z = disc.z * disc.z * (inverse - disc.inverse)
    return x * x + y * y + z * z


@wp.kernel
def splat_depth(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: SplatCamera,
    workers: int,
    z_buffer: wp.array(dtype=wp.float32),
) -> None:
    """Inverse depth (E * H * W) of the nearest disc at every pixel."""
    k, worker = wp.tid()
    b = first_env + k
    width = camera.width
    image = k * camera.height * width
    count = visible.count[k]
    j = int(worker)
    while j < count:
        disc = project_disc(
            fetch(visible.position, k, j),
            fetch(visible.normal, k, j),
            fetch(surfels.radius, b, fetch(visible.index, k, j)),
            camera,
        )
        v = int(disc.low[1])
        while v <= disc.high[1]:
            dv = float(v) - disc.v
            row = image + v * width
            u = int(disc.low[0])
            while u <= disc.high[0]:
                du = float(u) - disc.u
                inverse = disc.inverse + du * disc.slope_u + dv * disc.slope_v
                inside = squared_offset(disc, du, dv, inverse) <= disc.rim
                raise_to(z_buffer, row + u, wp.where(inside, inverse, 0.0))
                u += 1
            v += 1
        j += workers


@wp.kernel
def splat_attributes(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: SplatCamera,
    workers: int,
    z_buffer: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=Sums),
) -> None:
    """Sum the discs of the front surface at every pixel.

    The weight is the confidence, at most ``max_weight``, falling off towards the disc's rim.
    """
    k, worker = wp.tid()
    b = first_env + k
    width = camera.width
    image = k * camera.height * width
    count = visible.count[k]
    j = int(worker)
    while j < count:
        n = fetch(visible.normal, k, j)
        i = fetch(visible.index, k, j)
        disc = project_disc(fetch(visible.position, k, j), n, fetch(surfels.radius, b, i), camera)
        color = fetch(surfels.color, b, i)
        confidence = wp.min(fetch(surfels.confidence, b, i), camera.max_weight)
        inverse_rim = 1.0 / disc.rim
        # Same surface: z < front + tolerance. To first order in inverse depth.
        reach = depth_tolerance(camera.tolerance_m, disc.z) * disc.inverse * disc.inverse
        v = int(disc.low[1])
        while v <= disc.high[1]:
            dv = float(v) - disc.v
            row = image + v * width
            u = int(disc.low[0])
            while u <= disc.high[0]:
                du = float(u) - disc.u
                inverse = disc.inverse + du * disc.slope_u + dv * disc.slope_v
                share = squared_offset(disc, du, dv, inverse) * inverse_rim
                if share <= 1.0 and inverse >= fetch(z_buffer, row + u) - reach:
                    w = confidence * (1.05 - share)
                    sample = Sums(
                        n[0], n[1], n[2], 1.0, color[0], color[1], color[2], 1.0 / inverse
                    )
                    wp.atomic_add(sums, row + u, w * sample)
                u += 1
            v += 1
        j += workers


@wp.kernel
def list_hidden(
    visible: VisibleList,
    camera: SplatCamera,
    workers: int,
    z_buffer: wp.array(dtype=wp.float32),
    hidden: VisibleList,
) -> None:
    """List the visible surfels well behind the front surface at their own pixel."""
    k, worker = wp.tid()
    image = k * camera.height * camera.width
    for j in range(worker, visible.count[k], workers):
        p = visible.position[k, j]
        u = floor_int(camera.focal[0] * p[0] / p[2] + camera.centre[0] + 0.5)
        v = floor_int(camera.focal[1] * p[1] / p[2] + camera.centre[1] + 0.5)
        if u >= 0 and u < camera.width and v >= 0 and v < camera.height:
            inverse = z_buffer[image + v * camera.width + u]
            if inverse > 0.0:
                front = 1.0 / inverse
                if p[2] > front + 2.0 * depth_tolerance(camera.tolerance_m, front):
                    slot = wp.atomic_add(hidden.count, k, 1)
                    hidden.index[k, slot] = visible.index[k, j]
                    hidden.position[k, slot] = p
                    hidden.normal[k, slot] = visible.normal[k, j]


@wp.func
def luma(color: wp.vec3) -> float:
    """ITU-R BT.601 luma."""
    return 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]


@wp.kernel
def resolve(
    sums: wp.array(dtype=Sums),
    camera: SplatCamera,
    vertices: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    intensity: wp.array(dtype=wp.float32),
    color: wp.array(dtype=wp.vec3),
) -> None:
    """Divide the sums by their weights; pixels that no disc covers become 0."""
    k, v = wp.tid()
    row = (k * camera.height + v) * camera.width
    y = (float(v) - camera.centre[1]) / camera.focal[1]
    per_column = 1.0 / camera.focal[0]
    for u in range(camera.width):
        s = sums[row + u]
        vertex = wp.vec3(0.0, 0.0, 0.0)
        normal = wp.vec3(0.0, 0.0, 0.0)
        mean = wp.vec3(0.0, 0.0, 0.0)
        if s[3] > 0.0:
            scale = 1.0 / s[3]
            z = s[7] * scale
            vertex = wp.vec3(z * (float(u) - camera.centre[0]) * per_column, z * y, z)
            normal = wp.normalize(wp.vec3(s[0], s[1], s[2]))
            mean = wp.vec3(s[4], s[5], s[6]) * scale
        vertices[row + u] = vertex
        normals[row + u] = normal
        color[row + u] = mean
        intensity[row + u] = luma(mean)
