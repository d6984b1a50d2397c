# ruff: noqa: UP018, RUF046
"""Kernels of the candidates' views: warp the points of a layered depth image into many cameras.

The front surface and the surface behind it, rendered from one reference pose with a wider field of
view (a layered depth image: Shade et al., SIGGRAPH 1998), hold about one point per pixel of the
predicted images, already averaged over the surfels. Warping these costs a tenth of splatting the
surfels into every view.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import wp
from ms_slam_env.slam.surfel.surfels import SplatCamera, rotation_of, translation_of

EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
DEPTH_BINS_PER_M = wp.constant(10.0)  # points in one depth bin compete by distance to the pixel
HIDDEN = wp.constant(wp.int64(1 << 39))  # key bit of points of the second layer
CLOSE_GAP = wp.constant(4)  # an empty pixel with at least so many neighbours is a gap to close


@wp.struct
class PointCloud:
    """Points of E reference views, in the reference camera's frame.

    The first ``front_count`` (E,) of ``count`` (E,) points are on the front surface.
    """

    position: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    intensity: wp.array2d(dtype=wp.float32)
    count: wp.array(dtype=wp.int32)
    front_count: wp.array(dtype=wp.int32)


@wp.kernel
def collect_points(
    vertices: wp.array3d(dtype=wp.vec3),
    normals: wp.array3d(dtype=wp.vec3),
    intensity: wp.array3d(dtype=wp.float32),
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
    motions: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    workers: int,
    keys: wp.array(dtype=wp.int64),
) -> None:
    """Z-buffer of the points: per pixel the smallest key of the points within a pixel of it.

    A key is (depth bin, layer, squared distance to the pixel, point), so among the points of one
    surface the one nearest to the pixel wins, and what the reference view hides stays hidden.
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
    keys: wp.array(dtype=wp.int64), image: int, v: int, u: int, height: int, width: int
) -> wp.int64:
    """Key of the farthest neighbour of an empty pixel that enough neighbours surround."""
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
    motions: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    keys: wp.array(dtype=wp.int64),
    intensity: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    """Images of the winning points; small gaps take the farthest neighbour, the rest is 0.

    The depth at a pixel is that of the winner's plane, within a tenth of the winner's own depth.
    """
    view, v = wp.tid()
    e = view / views_per_env
    R = rotation_of(motions[view])
    t = translation_of(motions[view])
    height = camera.height
    width = camera.width
    image = view * height * width
    row = image + v * width
    # Planes are met in the reference frame, where the points are: n . (p + shift) = z n . ray.
    R_back = wp.transpose(R)
    shift = R_back * t
    across = wp.vec3(R_back[0, 0], R_back[1, 0], R_back[2, 0]) / camera.focal[0]
    first_ray = R_back * wp.vec3(
        -camera.centre[0] / camera.focal[0], (float(v) - camera.centre[1]) / camera.focal[1], 1.0
    )
    forward = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    for u in range(width):
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
    vertices: wp.array3d(dtype=wp.vec3),
    normals_of_view: wp.array3d(dtype=wp.vec3),
    intensity_of_view: wp.array3d(dtype=wp.float32),
    views_per_env: int,
    n: int,
    intensity: wp.array3d(dtype=wp.float32),
    depth: wp.array3d(dtype=wp.float32),
    normals: wp.array3d(dtype=wp.vec3),
) -> None:
    """Copy the n-th rendered view of every env to its place among the predicted ones."""
    e, v, u = wp.tid()
    view = e * views_per_env + n
    intensity[view, v, u] = intensity_of_view[e, v, u]
    depth[view, v, u] = vertices[e, v, u][2]
    normals[view, v, u] = normals_of_view[e, v, u]
