# mypy: disable-error-code="empty-body"
# ruff: noqa: UP018, RUF046
"""Fuse a live frame into the map: average surfels with its readings, and start new ones.

Association is projective (Keller et al., 3DV 2013, section 4), but from the surfel to the image:
each visible surfel looks at the four readings around its projection. So its position in the image
is exact to a fraction of a pixel, and no surfel hides another from being updated. The papers' index
image approaches this as its resolution grows; here none is needed. A reading starts a new surfel
only if no surfel of the same surface projects close to it, so a mapped point that is seen again,
with noise or between the old pixels, makes no second surfel.

On the CPU, a surfel takes about a hundred operations and few branches; one surfel at a time takes
several times as long as eight at a time. So the rule is written as short loops over a few surfels
with local arrays for intermediate values, and the compiler vectorizes the loops without branches
over eight surfels. On a GPU every thread takes one surfel at a time, and the loops and arrays
vanish.

A CPU also waits for memory. So the surfels of a few blocks are culled and updated before the next
blocks are read, and each is fetched once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.slam.surfel.device import fetch, put
from ms_slam_env.slam.surfel.frustum_culling import frustum_of, list_some_visible
from ms_slam_env.slam.surfel.surfels import (
    BLOCK_SIZE,
    CullingBlocks,
    SeenWindow,
    SplatCamera,
    Surfels,
    VisibleList,
    rotation_of,
    translation_of,
)

COARSER = wp.constant(1.5)  # a reading whose radius is this factor larger is ignored (Keller)
FULL_WEIGHT_SIGMA_M = 0.048  # readings with more noise weigh less; reached at 4 m by default
STEEPEST = wp.constant(0.3)  # cosine of the view angle below which radii no longer grow


@wp.struct
class FusionParameters:
    """Numbers of the fusion rule."""

    distance_m: float  # depth tolerance at 1 m
    min_cosine: float  # of the angle between the normals of a surfel and a reading
    coverage_px: float  # a surfel this close to a pixel covers it
    radius_px: float  # radius of a new surfel, in pixels of the view that made it
    max_confidence: float  # limit of the confidence, which is the weight of the past
    full_m: float  # readings beyond this depth weigh less, by their variance


@wp.struct
class FusedFrame:
    """The frames to fuse, images flat; poses, time, weight and mask are (B,)."""

    poses: wp.array[wp.mat44]  # T_world_camera
    mask: wp.array[wp.int32]  # 0 leaves an env's map as it is
    time: wp.array[wp.int32]  # index of the frame in its episode
    weight: wp.array[wp.float32]  # in (0, 1], lower for a fast camera
    depth: wp.array[wp.float32]  # (B * H * W) metres
    normals: wp.array[wp.vec3]  # camera frame
    color: wp.array[wp.vec3]  # RGB
    radial: wp.array[wp.float32]  # (H * W) weights of the pixels
    covered: wp.array[wp.int32]  # 1 where a surfel of the map covers the pixel
    moving: wp.array[wp.int32]  # 1 where something moves, which is not mapped


CENTRALITY = 1.0 / (2.0 * 0.6 * 0.6)  # of the radial weight, Keller section 4.1


@wp.func
def reading_radius(z: float, n: wp.vec3, vertex: wp.vec3, focal: float, radius_px: float) -> float:
    """Radius of the disc that covers a pixel's footprint on a surface seen at an angle."""
    cosine = -wp.dot(n, vertex) / wp.length(vertex)
    return radius_px * z / (focal * wp.max(cosine, STEEPEST))


@wp.func
def range_weight(z: float, full_m: float) -> float:
    """Weight of a reading at depth z: the inverse of its variance, which grows with z^4."""
    nearness = wp.min(full_m / z, 1.0)
    return nearness * nearness * nearness * nearness


def radial_weights(height: int, width: int) -> NDArray[np.float32]:
    """Gaussian weights (H, W) of distance to the centre over half the diagonal (Keller, 4.1)."""
    v, u = np.mgrid[:height, :width]
    squared = (u - 0.5 * (width - 1)) ** 2 + (v - 0.5 * (height - 1)) ** 2
    return np.exp(-CENTRALITY * squared / (0.25 * (width**2 + height**2))).astype(np.float32)


@wp.kernel
def add_surfels(
    surfels: Surfels,
    capacity: int,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
    workers: int,
) -> None:
    """Start a surfel at every uncovered, unmoving reading with a normal; a full map drops it.

    ``count`` exceeds the capacity when surfels are dropped; ``put_back`` corrects it.
    """
    b, worker = wp.tid()
    if frame.mask[b] == 0:
        return
    height = camera.height
    width = camera.width
    image = b * height * width
    T = frame.poses[b]
    R = rotation_of(T)
    t = translation_of(T)
    pixel = int(worker)
    while pixel < height * width:
        z = fetch(frame.depth, image + pixel)
        at = image + pixel
        if fetch(frame.covered, at) == 0 and fetch(frame.moving, at) == 0 and z > 0.0:
            v = pixel / width
            u = pixel - v * width
            p = wp.vec3(
                z * (float(u) - camera.centre[0]) / camera.focal[0],
                z * (float(v) - camera.centre[1]) / camera.focal[1],
                z,
            )
            n = fetch(frame.normals, image + pixel)
            if wp.dot(n, p) < 0.0:
                slot = wp.atomic_add(surfels.count, b, 1)
                if slot < capacity:
                    put(surfels.position, b, slot, R * p + t)
                    put(surfels.normal, b, slot, R * n)
                    put(surfels.color, b, slot, fetch(frame.color, image + pixel))
                    radius = reading_radius(z, n, p, camera.focal[0], parameters.radius_px)
                    put(surfels.radius, b, slot, radius)
                    weight = frame.weight[b] * fetch(frame.radial, pixel)
                    weight *= range_weight(z, parameters.full_m)
                    put(surfels.confidence, b, slot, weight)
                    put(surfels.created, b, slot, frame.time[b])
                    put(surfels.seen, b, slot, frame.time[b])
                else:
                    wp.atomic_add(surfels.dropped, b, 1)
        pixel += workers


TOGETHER = wp.constant(8)  # blocks that are culled before their surfels are updated


@wp.func_native(native_source("surfel_update", "update_some", STEEPEST=STEEPEST, COARSER=COARSER))
def update_some(
    surfels: Surfels,
    visible: VisibleList,
    b: int,
    first: int,
    end: int,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
) -> int:
    """Update listed surfels from ``first`` on, at most to ``end``; return their number."""


@wp.kernel
def update_surfels(
    surfels: Surfels,
    visible: VisibleList,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
    workers: int,
) -> None:
    """Average each visible surfel with the readings around its projection; mark covered pixels.

    Three kinds of surfels lose confidence, and die at zero: those in front of all four readings,
    where space is free; those on a moving reading, mapped before it was known to move; and those
    whose normal contradicts the surface.
    """
    b, worker = wp.tid()
    if frame.mask[b] == 0:
        return
    count = visible.count[b]
    j = int(worker)
    while j < count:
        end = wp.where(workers == 1, count, j + 1)
        updated = update_some(surfels, visible, b, j, end, camera, parameters, frame)
        j += wp.where(workers == 1, updated, workers)


@wp.kernel
def cull_and_update(
    surfels: Surfels,
    blocks: CullingBlocks,
    window: SeenWindow,
    visible: VisibleList,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
) -> None:
    """Alternate ``cull`` and ``update_surfels``, a few blocks at a time; for a single worker.

    The list is working memory; its final contents have no meaning.
    """
    b = wp.tid()
    if frame.mask[b] == 0:
        return
    frustum = frustum_of(frame.poses[b], camera, 0.0)
    seen_from = window.seen_from[b]
    seen_to = window.seen_to[b]
    num_listed = blocks.num_listed[b]
    start = int(0)
    while start < num_listed:
        visible.count[b] = 0
        for k in range(start, wp.min(start + TOGETHER, num_listed)):
            first = int(blocks.listed[b, k] * BLOCK_SIZE)
            end = wp.min(first + BLOCK_SIZE, surfels.count[b])
            while first < end:
                first += list_some_visible(
                    surfels, b, first, end, frustum, seen_from, seen_to, b, visible
                )
        count = visible.count[b]
        j = int(0)
        while j < count:
            j += update_some(surfels, visible, b, j, count, camera, parameters, frame)
        start += TOGETHER
