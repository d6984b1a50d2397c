"""Fusing a live frame into the map: the kernel that starts new surfels.

Association is projective (Keller et al., 3DV 2013, section 4), but from the surfel to the image:
each visible surfel looks at the four readings around its projection (``fusion_update``), so its
position in the image is kept to a fraction of a pixel and no surfel hides another from being
updated. That is the limit of the papers' index image of higher and higher resolution, and needs no
index image. A reading starts a new surfel only where no surfel of the same surface projects close
to it: an already mapped point, seen again with noise or from between the old pixels, makes no
second surfel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.discs import SplatCamera
from ms_slam_env.slam.surfel.fusion_update import STEEPEST, FusionParameters
from ms_slam_env.slam.surfel.memory import fetch, put
from ms_slam_env.slam.surfel.surfel_arrays import Surfels, rotation_of, translation_of

CENTRALITY = 1.0 / (2.0 * 0.6 * 0.6)  # of the radial weight, Keller section 4.1


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
