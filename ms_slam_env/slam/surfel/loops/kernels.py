"""Kernels of loop closure: bend the surfels of one env, and make old ones active again."""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.discs import SplatCamera, floor_int
from ms_slam_env.slam.surfel.surfel_arrays import Surfels, VisibleList, depth_tolerance

NEAREST = wp.constant(5)  # of deformation_graph: NEIGHBOURS that move a point, and the next one


@wp.struct
class Nodes:
    """A deformation of one map: position (M,), linear part and translation of the nodes."""

    position: wp.array(dtype=wp.vec3)
    R: wp.array(dtype=wp.mat33)
    t: wp.array(dtype=wp.vec3)


@wp.kernel
def deform_surfels(
    surfels: Surfels,
    b: int,
    nodes: Nodes,
    first: wp.array(dtype=wp.int32),  # of each surfel's candidate nodes
    window: int,  # number of candidates
) -> None:
    """Move position and normal of every surfel of env b: ``Deformation.points`` in float32.

    The normal turns with the blend of R, which is close to a rotation; the paper's inverse
    transpose of R is the same for a rotation.
    """
    i = wp.tid()
    p = surfels.position[b, i]
    index = wp.vector(length=NEAREST, dtype=wp.int32)
    distance = wp.vector(length=NEAREST, dtype=wp.float32)
    for k in range(NEAREST):
        distance[k] = 1.0e30
    for candidate in range(window):
        n = first[i] + candidate
        d = wp.length(nodes.position[n] - p)
        place = int(NEAREST)
        while place > 0 and d < distance[place - 1]:
            place -= 1
        k = int(NEAREST) - 1
        while k > place:
            distance[k] = distance[k - 1]
            index[k] = index[k - 1]
            k -= 1
        if place < NEAREST:
            distance[place] = d
            index[place] = n
    per_farthest = 1.0 / wp.max(distance[NEAREST - 1], 1.0e-12)
    total = wp.float32(0.0)
    moved = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.vec3(0.0, 0.0, 0.0)
    normal = surfels.normal[b, i]
    for k in range(NEAREST - 1):
        share = 1.0 - distance[k] * per_farthest
        weight = share * share + 1.0e-6
        n = index[k]
        centre = nodes.position[n]
        total += weight
        moved += weight * (nodes.R[n] * (p - centre) + centre + nodes.t[n])
        turned += weight * (nodes.R[n] * normal)
    surfels.position[b, i] = moved / total
    surfels.normal[b, i] = wp.normalize(turned)


@wp.func
def pixel_of(p: wp.vec3, camera: SplatCamera):
    """Pixel (u, v) of the image nearest to the projection of a point."""
    u = floor_int(camera.focal[0] * p[0] / p[2] + camera.centre[0] + 0.5)
    v = floor_int(camera.focal[1] * p[1] / p[2] + camera.centre[1] + 0.5)
    return wp.vec2i(wp.clamp(u, 0, camera.width - 1), wp.clamp(v, 0, camera.height - 1))


@wp.kernel
def reactivate(
    surfels: Surfels,
    b: int,
    seen_from: int,
    seen_to: int,
    now: int,
) -> None:
    """Count the surfels of env b that were last seen within these frames as seen now."""
    i = wp.tid()
    seen = surfels.seen[b, i]
    if seen >= seen_from and seen <= seen_to:
        surfels.seen[b, i] = now


@wp.kernel
def merge(
    surfels: Surfels,
    b: int,
    visible: VisibleList,  # of the active surfels
    camera: SplatCamera,
    vertices: wp.array3d(dtype=wp.vec3),  # image of the inactive surfels
    normals: wp.array3d(dtype=wp.vec3),
    min_cosine: float,
    stable: float,  # confidence
) -> None:
    """Remove the unstable active surfels of env b that lie on a surface mapped before."""
    j = wp.tid()
    p = visible.position[b, j]
    pixel = pixel_of(p, camera)
    front = vertices[b, pixel[1], pixel[0]][2]
    if front > 0.0 and wp.abs(p[2] - front) < depth_tolerance(camera.tolerance_m, front):
        i = visible.index[b, j]
        alike = wp.dot(visible.normal[b, j], normals[b, pixel[1], pixel[0]]) > min_cosine
        if alike and surfels.confidence[b, i] < stable:
            surfels.confidence[b, i] = 0.0
            wp.atomic_add(surfels.dead, b, 1)
