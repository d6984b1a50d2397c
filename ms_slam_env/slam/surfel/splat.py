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
from ms_slam_env.slam.surfel.discs import Discs, SplatCamera, floor_int
from ms_slam_env.slam.surfel.memory import fetch, put, raise_to
from ms_slam_env.slam.surfel.surfel_arrays import (
    SeenWindow,
    Surfels,
    VisibleList,
    depth_tolerance,
    rotation_of,
    translation_of,
)

Sums = wp.types.vector(length=8, dtype=wp.float32)
"""Weighted sums of a pixel: normal (3), weight, colour (3), depth."""


@wp.kernel
def cull(
    surfels: Surfels,
    first_env: int,
    poses: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    margin_px: float,
    workers: int,
    window: SeenWindow,
    visible: VisibleList,
) -> None:
    """List the living surfels of a window in front of the camera, facing it, within its frustum.

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
    seen_from = fetch(window.seen_from, b)
    seen_to = fetch(window.seen_to, b)
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
                seen = fetch(surfels.seen, b, i)
                is_alive = fetch(surfels.confidence, b, i) > 0.0
                if wp.dot(n, p) < 0.0 and is_alive and seen >= seen_from and seen <= seen_to:
                    slot = wp.atomic_add(visible.count, k, 1)
                    put(visible.index, k, slot, i)
                    put(visible.position, k, slot, p)
                    put(visible.normal, k, slot, n)
                    put(visible.radius, k, slot, fetch(surfels.radius, b, i))
        i += workers


@wp.func
def squared_offset(x: float, y: float, z: float, inverse_offset: float) -> float:
    """Squared distance (m2) from the centre of a disc at depth z of a point of its plane.

    The point is x, y (m) and an inverse depth away from the centre. To first order in the offset:
    only the disc's rim moves, by less than its perspective.
    """
    away = z * z * inverse_offset
    return x * x + y * y + away * away


@wp.kernel
def splat_depth(
    visible: VisibleList,
    camera: SplatCamera,
    workers: int,
    discs: Discs,
    z_buffer: wp.array(dtype=wp.float32),
) -> None:
    """Inverse depth (E * H * W) of the nearest disc at every pixel; list the discs on a pixel."""
    k, worker = wp.tid()
    width = camera.width
    image = k * camera.height * width
    count = visible.count[k]
    j = int(worker)
    while j < count:
        left = fetch(discs.left, k, j)
        right = fetch(discs.right, k, j)
        row = fetch(discs.top, k, j)
        bottom = fetch(discs.bottom, k, j)
        if left <= right and row <= bottom:
            put(discs.drawn, k, wp.atomic_add(discs.num_drawn, k, 1), j)
            centre_u = fetch(discs.u, k, j)
            centre_v = fetch(discs.v, k, j)
            centre_inverse = fetch(discs.inverse, k, j)
            slope_u = fetch(discs.slope_u, k, j)
            slope_v = fetch(discs.slope_v, k, j)
            rim = fetch(discs.rim, k, j)
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
                    inverse = wp.where(squared <= rim, centre_inverse + offset, 0.0)
                    raise_to(z_buffer, image + row * width + u, inverse)
                    u += 1
                row += 1
        j += workers


@wp.kernel
def splat_attributes(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: SplatCamera,
    workers: int,
    discs: Discs,
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
    count = discs.num_drawn[k]
    d = int(worker)
    while d < count:
        j = fetch(discs.drawn, k, d)
        left = fetch(discs.left, k, j)
        right = fetch(discs.right, k, j)
        row = fetch(discs.top, k, j)
        bottom = fetch(discs.bottom, k, j)
        centre_u = fetch(discs.u, k, j)
        centre_v = fetch(discs.v, k, j)
        centre_inverse = fetch(discs.inverse, k, j)
        slope_u = fetch(discs.slope_u, k, j)
        slope_v = fetch(discs.slope_v, k, j)
        per_rim = 1.0 / fetch(discs.rim, k, j)
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
                    hidden.radius[k, slot] = visible.radius[k, j]


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
