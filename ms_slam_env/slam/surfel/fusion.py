# ruff: noqa: UP018, RUF046
# Warp code: float(0.0) declares a variable that changes.
"""Kernels that fuse a live frame into the map.

Association is projective (Keller et al., 3DV 2013, section 4), but from the surfel to the image:
each visible surfel looks at the four readings around its projection, so its position in the image
is kept to a fraction of a pixel and no surfel hides another from being updated. That is the limit
of the papers' index image of higher and higher resolution, and needs no index image. A reading
starts a new surfel only where no surfel of the same surface projects close to it: an already
mapped point, seen again with noise or from between the old pixels, makes no second surfel.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.splat import SplatCamera, floor_int
from ms_slam_env.slam.surfel.surfel_arrays import Surfels, VisibleList, depth_tolerance

COARSER = wp.constant(1.5)  # a reading with a radius this much larger refines nothing (Keller)
CENTRALITY = wp.constant(1.0 / (2.0 * 0.6 * 0.6))  # of the radial weight, Keller section 4.1
STEEPEST = wp.constant(0.3)  # cosine of the view angle below which radii no longer grow


@wp.struct
class FusionParameters:
    """Numbers of the fusion rule.

    Attributes:
        distance_m: depth tolerance at 1 m.
        min_cosine: of the angle between the normals of a surfel and a reading.
        coverage_px: a surfel this close to a pixel covers it.
        radius_px: radius of a new surfel, in pixels of the view that made it.
        max_confidence: where confidence, the weight of the past, stops growing.
    """

    distance_m: float
    min_cosine: float
    coverage_px: float
    radius_px: float
    max_confidence: float


@wp.func
def reading_radius(z: float, n: wp.vec3, vertex: wp.vec3, focal: float, radius_px: float):
    """Radius of the disc that covers a pixel's footprint on a surface seen at an angle."""
    cosine = -wp.dot(n, vertex) / wp.length(vertex)
    return radius_px * z / (focal * wp.max(cosine, STEEPEST))


@wp.func
def radial_weight(u: float, v: float, width: int, height: int):
    """Gaussian of the distance to the image's centre over half the diagonal (Keller, 4.1)."""
    x = u - 0.5 * float(width - 1)
    y = v - 0.5 * float(height - 1)
    half_diagonal_squared = 0.25 * float(width * width + height * height)
    return wp.exp(-CENTRALITY * (x * x + y * y) / half_diagonal_squared)


@wp.kernel
def update_surfels(
    surfels: Surfels,
    visible: VisibleList,
    poses: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    mask: wp.array(dtype=wp.int32),
    time: wp.array(dtype=wp.int32),
    weight: wp.array(dtype=wp.float32),
    parameters: FusionParameters,
    workers: int,
    live_vertices: wp.array3d(dtype=wp.vec3),
    live_normals: wp.array3d(dtype=wp.vec3),
    live_color: wp.array3d(dtype=wp.vec3),
    covered: wp.array3d(dtype=wp.int32),
) -> None:
    """Average each visible surfel with the readings about its projection; mark covered pixels.

    A surfel in front of all four readings contradicts free space; one whose normal disagrees
    contradicts the surface: both lose confidence and die at zero.
    """
    b, worker = wp.tid()
    if mask[b] == 0:
        return
    height = live_vertices.shape[1]
    width = live_vertices.shape[2]
    T = poses[b]
    coverage_squared = parameters.coverage_px * parameters.coverage_px
    for j in range(worker, visible.count[b], workers):
        p = visible.position[b, j]
        n = visible.normal[b, j]
        u = camera.focal[0] * p[0] / p[2] + camera.centre[0]
        v = camera.focal[1] * p[1] / p[2] + camera.centre[1]
        u0 = floor_int(u)
        v0 = floor_int(v)
        tolerance = depth_tolerance(parameters.distance_m, p[2])
        total = float(0.0)
        shift = float(0.0)
        mean_color = wp.vec3(0.0, 0.0, 0.0)
        behind = int(0)
        for corner in range(4):  # without branches, which noise would make guesses
            x = u0 + corner % 2
            y = v0 + corner / 2
            inside = x >= 0 and x < width and y >= 0 and y < height
            x = wp.clamp(x, 0, width - 1)
            y = wp.clamp(y, 0, height - 1)
            q = live_vertices[b, y, x]
            difference = q - p
            distance = wp.dot(n, difference)
            valid = inside and q[2] > 0.0
            near = wp.abs(distance) < tolerance and wp.abs(difference[2]) < 3.0 * tolerance
            du = wp.abs(float(x) - u)
            dv = wp.abs(float(y) - v)
            w = wp.where(valid and near, (1.0 - du) * (1.0 - dv), 0.0)
            total += w
            shift += w * distance
            mean_color += w * live_color[b, y, x]
            covers = valid and near and du * du + dv * dv < coverage_squared
            wp.atomic_max(covered, b, y, x, wp.where(covers, 1, 0))
            behind += wp.where(valid and not near and difference[2] > 3.0 * tolerance, 1, 0)
        i = visible.index[b, j]
        confidence = surfels.confidence[b, i]
        if behind == 4:
            confidence = 0.5 * confidence - 0.5
        elif total > 0.25:
            x = wp.clamp(floor_int(u + 0.5), 0, width - 1)
            y = wp.clamp(floor_int(v + 0.5), 0, height - 1)
            live_normal = live_normals[b, y, x]
            agreement = wp.dot(live_normal, n)
            alpha = weight[b] * radial_weight(u, v, width, height)
            surfels.seen[b, i] = time[b]
            if agreement > parameters.min_cosine:
                radius = surfels.radius[b, i]
                live_radius = reading_radius(
                    p[2], live_normal, p, camera.focal[0], parameters.radius_px
                )
                if live_radius < COARSER * radius:
                    keep = confidence / (confidence + alpha)
                    take = 1.0 - keep
                    moved = p + (take * shift / total) * n
                    turned = wp.normalize(keep * n + take * live_normal)
                    surfels.position[b, i] = wp.transform_point(T, moved)
                    surfels.normal[b, i] = wp.transform_vector(T, turned)
                    surfels.color[b, i] = keep * surfels.color[b, i] + (take / total) * mean_color
                    surfels.radius[b, i] = keep * radius + take * live_radius
                confidence = wp.min(confidence + alpha, parameters.max_confidence)
            elif wp.dot(live_normal, live_normal) > 0.0:
                confidence -= 0.5 * alpha
        if confidence <= 0.0:
            confidence = 0.0
            wp.atomic_add(surfels.dead, b, 1)
        surfels.confidence[b, i] = confidence


@wp.kernel
def add_surfels(
    surfels: Surfels,
    capacity: int,
    poses: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    mask: wp.array(dtype=wp.int32),
    time: wp.array(dtype=wp.int32),
    weight: wp.array(dtype=wp.float32),
    parameters: FusionParameters,
    workers: int,
    live_vertices: wp.array3d(dtype=wp.vec3),
    live_normals: wp.array3d(dtype=wp.vec3),
    live_color: wp.array3d(dtype=wp.vec3),
    covered: wp.array3d(dtype=wp.int32),
) -> None:
    """Start a surfel at every uncovered reading with a normal; a full map drops it.

    ``count`` runs past the capacity when surfels are dropped; ``put_back`` sets it right.
    """
    b, worker = wp.tid()
    if mask[b] == 0:
        return
    height = live_vertices.shape[1]
    width = live_vertices.shape[2]
    T = poses[b]
    for pixel in range(worker, height * width, workers):
        v = pixel / width
        u = pixel - v * width
        if covered[b, v, u] == 0:
            p = live_vertices[b, v, u]
            n = live_normals[b, v, u]
            if p[2] > 0.0 and wp.dot(n, p) < 0.0:
                slot = wp.atomic_add(surfels.count, b, 1)
                if slot < capacity:
                    surfels.position[b, slot] = wp.transform_point(T, p)
                    surfels.normal[b, slot] = wp.transform_vector(T, n)
                    surfels.color[b, slot] = live_color[b, v, u]
                    surfels.radius[b, slot] = reading_radius(
                        p[2], n, p, camera.focal[0], parameters.radius_px
                    )
                    surfels.confidence[b, slot] = weight[b] * radial_weight(
                        float(u), float(v), width, height
                    )
                    surfels.created[b, slot] = time[b]
                    surfels.seen[b, slot] = time[b]
                else:
                    wp.atomic_add(surfels.dropped, b, 1)
