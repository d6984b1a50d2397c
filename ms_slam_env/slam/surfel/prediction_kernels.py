"""Kernels of the candidates' views: warp the points of a layered depth image into many cameras.

The front surface and the surface behind it, rendered from one reference pose with a wider field of
view (a layered depth image: Shade et al., SIGGRAPH 1998), hold about one point per pixel of the
predicted images, already averaged over the surfels. Warping these costs a tenth of splatting the
surfels into every view.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.surfel_arrays import rotation_of, translation_of

EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
DEPTH_BINS_PER_M = wp.constant(40.0)  # points in one depth bin compete by distance to the pixel
CLOSE_GAP = wp.constant(4)  # an empty pixel with at least so many neighbours is a gap to close


@wp.struct
class PointCloud:
    """Points of E reference views, in the reference camera's frame; ``count`` (E,)."""

    position: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    intensity: wp.array2d(dtype=wp.float32)
    count: wp.array(dtype=wp.int32)


@wp.kernel
def collect_points(
    vertices: wp.array3d(dtype=wp.vec3),
    normals: wp.array3d(dtype=wp.vec3),
    intensity: wp.array3d(dtype=wp.float32),
    points: PointCloud,
):
    """Append the surface points of one layer."""
    e, v = wp.tid()
    for u in range(vertices.shape[2]):
        p = vertices[e, v, u]
        if p[2] > 0.0:
            slot = wp.atomic_add(points.count, e, 1)
            points.position[e, slot] = p
            points.normal[e, slot] = normals[e, v, u]
            points.intensity[e, slot] = intensity[e, v, u]


@wp.func
def plane_depth(p: wp.vec3, n: wp.vec3, u: float, v: float, camera: wp.vec4):
    """Depth at pixel (u, v) of the plane through p, kept within a tenth of the depth of p."""
    ray = wp.vec3((u - camera[2]) / camera[0], (v - camera[3]) / camera[1], 1.0)
    slope = wp.min(wp.dot(n, ray), -1.0e-6)
    return wp.clamp(wp.dot(n, p) / slope, 0.9 * p[2], 1.1 * p[2])


@wp.kernel
def scatter_points(
    points: PointCloud,
    views_per_env: int,
    motions: wp.array(dtype=wp.mat44),
    camera: wp.vec4,
    z_near: float,
    workers: int,
    keys: wp.array3d(dtype=wp.int64),
):
    """Z-buffer of the points: per pixel the smallest key of the points within a pixel of it.

    A key is (depth bin, squared distance to the pixel, point), so among the points of one surface
    the one nearest to the pixel wins. ``motions[v]`` is T_view_reference.
    """
    view, worker = wp.tid()
    e = view / views_per_env
    height = keys.shape[1]
    width = keys.shape[2]
    R = rotation_of(motions[view])
    t = translation_of(motions[view])
    right = float(width)
    bottom = float(height)
    for j in range(worker, points.count[e], workers):
        p = R * points.position[e, j] + t
        if p[2] > z_near:
            inverse = 1.0 / p[2]
            u = camera[0] * p[0] * inverse + camera[2]
            v = camera[1] * p[1] * inverse + camera[3]
            if u > -1.0 and u < right and v > -1.0 and v < bottom:
                if wp.dot(R * points.normal[e, j], p) < 0.0:
                    u0 = int(wp.floor(u))
                    v0 = int(wp.floor(v))
                    near = wp.int64(int(p[2] * DEPTH_BINS_PER_M)) << wp.int64(40)
                    du = u - float(u0)
                    dv = v - float(v0)
                    for corner in range(4):
                        x = corner % 2
                        y = corner / 2
                        if u0 + x >= 0 and u0 + x < width and v0 + y >= 0 and v0 + y < height:
                            a = float(x) - du
                            b = float(y) - dv
                            off = wp.int64(int((a * a + b * b) * 127.0)) << wp.int64(32)
                            wp.atomic_min(keys, view, v0 + y, u0 + x, near + off + wp.int64(j))


@wp.func
def gap_key(keys: wp.array3d(dtype=wp.int64), view: int, v: int, u: int):
    """Key of the farthest neighbour of an empty pixel that most neighbours surround."""
    found = int(0)
    farthest = wp.int64(-1)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            x = u + du
            y = v + dv
            if x >= 0 and x < keys.shape[2] and y >= 0 and y < keys.shape[1]:
                key = keys[view, y, x]
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
    motions: wp.array(dtype=wp.mat44),
    camera: wp.vec4,
    keys: wp.array3d(dtype=wp.int64),
    intensity: wp.array3d(dtype=wp.float32),
    depth: wp.array3d(dtype=wp.float32),
    normals: wp.array3d(dtype=wp.vec3),
):
    """Images of the winning points; small gaps take the farthest neighbour, the rest is 0."""
    view, v = wp.tid()
    e = view / views_per_env
    R = rotation_of(motions[view])
    t = translation_of(motions[view])
    for u in range(keys.shape[2]):
        key = keys[view, v, u]
        if key == EMPTY:
            key = gap_key(keys, view, v, u)
        if key == EMPTY:
            intensity[view, v, u] = 0.0
            depth[view, v, u] = 0.0
            normals[view, v, u] = wp.vec3(0.0, 0.0, 0.0)
        else:
            j = int(key & wp.int64(0xFFFFFFFF))
            p = R * points.position[e, j] + t
            n = R * points.normal[e, j]
            intensity[view, v, u] = points.intensity[e, j]
            depth[view, v, u] = plane_depth(p, n, float(u), float(v), camera)
            normals[view, v, u] = n


@wp.kernel
def copy_view(
    vertices: wp.array3d(dtype=wp.vec3),
    normals_of_view: wp.array3d(dtype=wp.vec3),
    intensity_of_view: wp.array3d(dtype=wp.float32),
    views_per_env: int,
    n: int,
    intensity: wp.array3d(dtype=wp.float32),
    depth: wp.array3d(dtype=wp.float32),
    normals: wp.array3d(dtype=wp.vec3),
):
    """Copy the n-th rendered view of every env to its place among the predicted ones."""
    e, v, u = wp.tid()
    view = e * views_per_env + n
    intensity[view, v, u] = intensity_of_view[e, v, u]
    depth[view, v, u] = vertices[e, v, u][2]
    normals[view, v, u] = normals_of_view[e, v, u]
