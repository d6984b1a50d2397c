"""Kernels that render surfels: cull, z-buffer of discs, average of the front surface, resolve.

Two passes over the visible discs: the first finds the nearest depth of every pixel, the second
averages all discs within the depth tolerance behind it (the visibility splatting of Botsch et al.,
"High-quality surface splatting on today's GPUs", 2005). The depth of a disc at a pixel is that of
the viewing ray's intersection with its plane. Launches are (envs, workers); the workers of an env
share its list, so the CPU's single worker keeps everything in registers.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.surfel_arrays import (
    Surfels,
    VisibleList,
    depth_tolerance,
    rotation_of,
    translation_of,
)

FAR = wp.constant(1.0e10)


@wp.kernel
def cull(
    surfels: Surfels,
    first_env: int,
    poses: wp.array(dtype=wp.mat44),
    camera: wp.vec4,
    width: int,
    height: int,
    z_near: float,
    z_far: float,
    margin_px: float,
    workers: int,
    visible: VisibleList,
):
    """List the living surfels in front of the camera, facing it, within its frustum.

    ``camera`` is (fx, fy, cx, cy); ``poses[k]`` is T_world_camera of env ``first_env + k``.
    """
    k, worker = wp.tid()
    b = first_env + k
    R = wp.transpose(rotation_of(poses[k]))
    t = -(R * translation_of(poses[k]))
    low_u = (-0.5 - margin_px - camera[2]) / camera[0]
    high_u = (float(width) - 0.5 + margin_px - camera[2]) / camera[0]
    low_v = (-0.5 - margin_px - camera[3]) / camera[1]
    high_v = (float(height) - 0.5 + margin_px - camera[3]) / camera[1]
    forward = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    for i in range(worker, surfels.count[b], workers):
        world = surfels.position[b, i]
        z = wp.dot(forward, world) + t[2]
        if z > z_near and z < z_far and surfels.confidence[b, i] > 0.0:
            p = R * world + t
            if p[0] > low_u * z and p[0] < high_u * z and p[1] > low_v * z and p[1] < high_v * z:
                n = R * surfels.normal[b, i]
                if wp.dot(n, p) < 0.0:
                    slot = wp.atomic_add(visible.count, k, 1)
                    visible.index[k, slot] = i
                    visible.position[k, slot] = p
                    visible.normal[k, slot] = n


@wp.func
def pixel_box(p: wp.vec3, radius: float, camera: wp.vec4, width: int, height: int):
    """Pixels (u_low, u_high, v_low, v_high), inclusive, that a ball about p can cover."""
    scale = 1.0 / p[2]
    u = camera[0] * p[0] * scale + camera[2]
    v = camera[1] * p[1] * scale + camera[3]
    reach_u = radius * camera[0] * scale
    reach_v = radius * camera[1] * scale
    return wp.vec4i(
        wp.max(int(wp.ceil(u - reach_u)), 0),
        wp.min(int(wp.floor(u + reach_u)), width - 1),
        wp.max(int(wp.ceil(v - reach_v)), 0),
        wp.min(int(wp.floor(v + reach_v)), height - 1),
    )


@wp.func
def disc_radius(radius: float, z: float, camera: wp.vec4, min_px: float, max_px: float):
    """Radius in metres, at least and at most so many pixels of this camera."""
    pixel = z / camera[0]
    return wp.clamp(radius, min_px * pixel, max_px * pixel)


@wp.kernel
def splat_depth(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: wp.vec4,
    min_px: float,
    max_px: float,
    workers: int,
    behind: wp.array3d(dtype=wp.float32),
    tolerance_m: float,
    z_buffer: wp.array3d(dtype=wp.float32),
):
    """Nearest disc depth (E, H, W) of every pixel, beyond the layer ``behind`` (0: any depth).

    A depth counts as beyond when it exceeds twice the tolerance.
    """
    k, worker = wp.tid()
    b = first_env + k
    height = z_buffer.shape[1]
    width = z_buffer.shape[2]
    for j in range(worker, visible.count[k], workers):
        p = visible.position[k, j]
        n = visible.normal[k, j]
        radius = disc_radius(surfels.radius[b, visible.index[k, j]], p[2], camera, min_px, max_px)
        box = pixel_box(p, radius, camera, width, height)
        plane = wp.dot(n, p)
        for v in range(box[2], box[3] + 1):
            for u in range(box[0], box[1] + 1):
                ray = wp.vec3(
                    (float(u) - camera[2]) / camera[0], (float(v) - camera[3]) / camera[1], 1.0
                )
                slope = wp.dot(n, ray)
                if slope < 0.0:
                    z = plane / slope
                    offset = z * ray - p
                    if wp.dot(offset, offset) <= radius * radius:
                        front = behind[k, v, u]
                        if front == 0.0 or z > front + 2.0 * depth_tolerance(tolerance_m, front):
                            wp.atomic_min(z_buffer, k, v, u, z)


@wp.kernel
def splat_attributes(
    surfels: Surfels,
    visible: VisibleList,
    first_env: int,
    camera: wp.vec4,
    min_px: float,
    max_px: float,
    max_weight: float,
    workers: int,
    tolerance_m: float,
    z_buffer: wp.array3d(dtype=wp.float32),
    normal_sum: wp.array3d(dtype=wp.vec4),
    color_sum: wp.array3d(dtype=wp.vec4),
):
    """Sum the discs of the front surface: (weight * normal, weight), weight * (colour, depth).

    The weight is the confidence, at most ``max_weight``, falling off towards the disc's rim.
    """
    k, worker = wp.tid()
    b = first_env + k
    height = z_buffer.shape[1]
    width = z_buffer.shape[2]
    for j in range(worker, visible.count[k], workers):
        p = visible.position[k, j]
        n = visible.normal[k, j]
        i = visible.index[k, j]
        radius = disc_radius(surfels.radius[b, i], p[2], camera, min_px, max_px)
        box = pixel_box(p, radius, camera, width, height)
        plane = wp.dot(n, p)
        color = surfels.color[b, i]
        confidence = wp.min(surfels.confidence[b, i], max_weight)
        for v in range(box[2], box[3] + 1):
            for u in range(box[0], box[1] + 1):
                ray = wp.vec3(
                    (float(u) - camera[2]) / camera[0], (float(v) - camera[3]) / camera[1], 1.0
                )
                slope = wp.dot(n, ray)
                if slope < 0.0:
                    z = plane / slope
                    offset = z * ray - p
                    share = wp.dot(offset, offset) / (radius * radius)
                    front = z_buffer[k, v, u]
                    if (
                        share <= 1.0
                        and z >= front
                        and z <= front + depth_tolerance(tolerance_m, front)
                    ):
                        w = confidence * (1.05 - share)
                        wp.atomic_add(normal_sum, k, v, u, wp.vec4(w * n[0], w * n[1], w * n[2], w))
                        wp.atomic_add(
                            color_sum,
                            k,
                            v,
                            u,
                            wp.vec4(w * color[0], w * color[1], w * color[2], w * z),
                        )


@wp.func
def luma(color: wp.vec3):
    """ITU-R BT.601 luma."""
    return 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]


@wp.kernel
def resolve(
    normal_sum: wp.array3d(dtype=wp.vec4),
    color_sum: wp.array3d(dtype=wp.vec4),
    camera: wp.vec4,
    vertices: wp.array3d(dtype=wp.vec3),
    normals: wp.array3d(dtype=wp.vec3),
    intensity: wp.array3d(dtype=wp.float32),
    color: wp.array3d(dtype=wp.vec3),
):
    """Divide the sums by their weights; pixels that no disc covers become 0."""
    k, v = wp.tid()
    for u in range(vertices.shape[2]):
        a = normal_sum[k, v, u]
        vertex = wp.vec3(0.0, 0.0, 0.0)
        normal = wp.vec3(0.0, 0.0, 0.0)
        mean = wp.vec3(0.0, 0.0, 0.0)
        if a[3] > 0.0:
            c = color_sum[k, v, u]
            z = c[3] / a[3]
            vertex = wp.vec3(
                z * (float(u) - camera[2]) / camera[0], z * (float(v) - camera[3]) / camera[1], z
            )
            normal = wp.normalize(wp.vec3(a[0], a[1], a[2]))
            mean = wp.vec3(c[0], c[1], c[2]) / a[3]
        vertices[k, v, u] = vertex
        normals[k, v, u] = normal
        color[k, v, u] = mean
        intensity[k, v, u] = luma(mean)
