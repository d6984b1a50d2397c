"""Kernels that fuse a live frame into the map.

Association is projective (Keller et al., 3DV 2013, section 4), but from the surfel to the image:
each visible surfel looks at the four readings around its projection, so its position in the image
is kept to a fraction of a pixel and no surfel hides another from being updated. That is the limit
of the papers' index image of higher and higher resolution, and needs no index image. A reading
starts a new surfel only where no surfel of the same surface projects close to it: an already
mapped point, seen again with noise or from between the old pixels, makes no second surfel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.discs import SplatCamera
from ms_slam_env.slam.surfel.memory import fetch, mark, put
from ms_slam_env.slam.surfel.surfel_arrays import (
    Surfels,
    VisibleList,
    depth_tolerance,
    rotation_of,
    translation_of,
)

COARSER = wp.constant(1.5)  # a reading with a radius this much larger refines nothing (Keller)
CENTRALITY = 1.0 / (2.0 * 0.6 * 0.6)  # of the radial weight, Keller section 4.1
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


def radial_weights(height: int, width: int) -> NDArray[np.float32]:
    """Gaussian (H, W) of the distance to the centre over half the diagonal (Keller, 4.1)."""
    v, u = np.mgrid[:height, :width]
    squared = (u - 0.5 * (width - 1)) ** 2 + (v - 0.5 * (height - 1)) ** 2
    return np.exp(-CENTRALITY * squared / (0.25 * (width**2 + height**2))).astype(np.float32)


@wp.struct
class Corner:
    """What one reading says about a surfel.

    Attributes:
        weight: bilinear weight, 0 if the reading is not of the surfel's surface.
        shift: weight times distance along the surfel's normal, metres.
        behind: 1 if the reading lies well behind the surfel, else 0.
    """

    weight: float
    shift: float
    behind: int


@wp.func
def look_at_reading(
    z: float, slope: float, offset: float, depth: float, tolerance: float, bilinear: float
):
    """Compare a reading at depth z with a surfel at ``depth``.

    ``slope`` z - ``offset`` is the reading's distance along the surfel's normal.
    """
    distance = slope * z - offset
    beyond = z - depth
    valid = z > 0.0
    near = valid and wp.abs(distance) < tolerance and wp.abs(beyond) < 3.0 * tolerance
    corner = Corner()
    corner.weight = wp.where(near, bilinear, 0.0)
    corner.shift = corner.weight * distance
    corner.behind = wp.where(valid and beyond > 3.0 * tolerance, 1, 0)
    return corner


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
    live_depth: wp.array(dtype=wp.float32),
    live_normals: wp.array(dtype=wp.vec3),
    live_color: wp.array(dtype=wp.vec3),
    radial: wp.array(dtype=wp.float32),
    covered: wp.array(dtype=wp.int32),
) -> None:
    """Average each visible surfel with the readings about its projection; mark covered pixels.

    A surfel in front of all four readings contradicts free space; one whose normal disagrees
    contradicts the surface: both lose confidence and die at zero. Images are flat.
    """
    b, worker = wp.tid()
    if mask[b] == 0:
        return
    height = camera.height
    width = camera.width
    image = b * height * width
    T = poses[b]
    R = rotation_of(T)
    t = translation_of(T)
    now = time[b]
    gain = weight[b]
    per_fx = 1.0 / camera.focal[0]
    per_fy = 1.0 / camera.focal[1]
    coverage_squared = parameters.coverage_px * parameters.coverage_px
    count = visible.count[b]
    j = int(worker)
    while j < count:
        p = fetch(visible.position, b, j)
        n = fetch(visible.normal, b, j)
        i = fetch(visible.index, b, j)
        j += workers
        per_z = 1.0 / p[2]
        u = camera.focal[0] * p[0] * per_z + camera.centre[0]
        v = camera.focal[1] * p[1] * per_z + camera.centre[1]
        u0 = wp.clamp(int(u), 0, width - 2)
        v0 = wp.clamp(int(v), 0, height - 2)
        right = wp.clamp(u - float(u0), 0.0, 1.0)
        down = wp.clamp(v - float(v0), 0.0, 1.0)
        left = 1.0 - right
        up = 1.0 - down
        pixel = image + v0 * width + u0
        tolerance = depth_tolerance(parameters.distance_m, p[2])
        # A reading at depth z is z (x, y, 1): its distance along n is z n . (x, y, 1) - n . p.
        offset = wp.dot(n, p)
        step_u = n[0] * per_fx
        step_v = n[1] * per_fy
        slope = (
            (float(u0) - camera.centre[0]) * step_u + (float(v0) - camera.centre[1]) * step_v + n[2]
        )
        c00 = look_at_reading(fetch(live_depth, pixel), slope, offset, p[2], tolerance, left * up)
        c01 = look_at_reading(
            fetch(live_depth, pixel + 1), slope + step_u, offset, p[2], tolerance, right * up
        )
        c10 = look_at_reading(
            fetch(live_depth, pixel + width),
            slope + step_v,
            offset,
            p[2],
            tolerance,
            left * down,
        )
        c11 = look_at_reading(
            fetch(live_depth, pixel + width + 1),
            slope + step_u + step_v,
            offset,
            p[2],
            tolerance,
            right * down,
        )
        l2 = left * left
        r2 = right * right
        u2 = up * up
        d2 = down * down
        mark(covered, pixel, c00.weight > 0.0 and r2 + d2 < coverage_squared)
        mark(covered, pixel + 1, c01.weight > 0.0 and l2 + d2 < coverage_squared)
        mark(covered, pixel + width, c10.weight > 0.0 and r2 + u2 < coverage_squared)
        mark(covered, pixel + width + 1, c11.weight > 0.0 and l2 + u2 < coverage_squared)
        total = c00.weight + c01.weight + c10.weight + c11.weight
        confidence = fetch(surfels.confidence, b, i)
        if total > 0.25:
            nearest = pixel + wp.where(right >= 0.5, 1, 0) + wp.where(down >= 0.5, width, 0)
            live_normal = fetch(live_normals, nearest)
            alpha = gain * fetch(radial, nearest - image)
            put(surfels.seen, b, i, now)
            if wp.dot(live_normal, n) > parameters.min_cosine:
                radius = fetch(surfels.radius, b, i)
                live_radius = reading_radius(
                    p[2], live_normal, p, camera.focal[0], parameters.radius_px
                )
                if live_radius < COARSER * radius:
                    per_total = 1.0 / total
                    shift = (c00.shift + c01.shift + c10.shift + c11.shift) * per_total
                    mean_color = (
                        c00.weight * fetch(live_color, pixel)
                        + c01.weight * fetch(live_color, pixel + 1)
                        + c10.weight * fetch(live_color, pixel + width)
                        + c11.weight * fetch(live_color, pixel + width + 1)
                    )
                    keep = confidence / (confidence + alpha)
                    take = 1.0 - keep
                    moved = p + (take * shift) * n
                    turned = wp.normalize(keep * n + take * live_normal)
                    put(surfels.position, b, i, R * moved + t)
                    put(surfels.normal, b, i, R * turned)
                    color = keep * fetch(surfels.color, b, i) + (take * per_total) * mean_color
                    put(surfels.color, b, i, color)
                    put(surfels.radius, b, i, keep * radius + take * live_radius)
                confidence = wp.min(confidence + alpha, parameters.max_confidence)
            elif wp.dot(live_normal, live_normal) > 0.0:
                confidence -= 0.5 * alpha
        elif c00.behind + c01.behind + c10.behind + c11.behind == 4:
            confidence = 0.5 * confidence - 0.5
        if confidence <= 0.0:
            confidence = 0.0
            wp.atomic_add(surfels.dead, b, 1)
        put(surfels.confidence, b, i, confidence)


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
    live_depth: wp.array(dtype=wp.float32),
    live_normals: wp.array(dtype=wp.vec3),
    live_color: wp.array(dtype=wp.vec3),
    radial: wp.array(dtype=wp.float32),
    covered: wp.array(dtype=wp.int32),
) -> None:
    """Start a surfel at every uncovered reading with a normal; a full map drops it.

    ``count`` runs past the capacity when surfels are dropped; ``put_back`` sets it right.
    """
    b, worker = wp.tid()
    if mask[b] == 0:
        return
    height = camera.height
    width = camera.width
    image = b * height * width
    T = poses[b]
    R = rotation_of(T)
    t = translation_of(T)
    pixel = int(worker)
    while pixel < height * width:
        z = fetch(live_depth, image + pixel)
        if fetch(covered, image + pixel) == 0 and z > 0.0:
            v = pixel / width
            u = pixel - v * width
            p = wp.vec3(
                z * (float(u) - camera.centre[0]) / camera.focal[0],
                z * (float(v) - camera.centre[1]) / camera.focal[1],
                z,
            )
            n = fetch(live_normals, image + pixel)
            if wp.dot(n, p) < 0.0:
                slot = wp.atomic_add(surfels.count, b, 1)
                if slot < capacity:
                    put(surfels.position, b, slot, R * p + t)
                    put(surfels.normal, b, slot, R * n)
                    put(surfels.color, b, slot, fetch(live_color, image + pixel))
                    radius = reading_radius(z, n, p, camera.focal[0], parameters.radius_px)
                    put(surfels.radius, b, slot, radius)
                    put(surfels.confidence, b, slot, weight[b] * fetch(radial, pixel))
                    put(surfels.created, b, slot, time[b])
                    put(surfels.seen, b, slot, time[b])
                else:
                    wp.atomic_add(surfels.dropped, b, 1)
        pixel += workers
