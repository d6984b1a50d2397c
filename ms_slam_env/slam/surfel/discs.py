"""Footprints of surfels in an image, worked out for many surfels at once."""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.memory import fetch, put
from ms_slam_env.slam.surfel.surfel_arrays import VisibleList


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
class Discs:
    """The surfels of a list in the image, arrays (B, capacity), and those that meet a pixel.

    Attributes:
        u: column of the centre.
        v: row of the centre.
        inverse: inverse depth of the centre.
        slope_u: change of inverse depth per column.
        slope_v: change of inverse depth per row.
        rim: squared radius, square metres.
        left: first column that the disc may cover; ``right``, ``top`` and ``bottom`` likewise.
        right: last column.
        top: first row.
        bottom: last row.
        drawn: places in the list of the discs that may cover a pixel.
        num_drawn: (B,) how many those are.
    """

    u: wp.array2d(dtype=wp.float32)
    v: wp.array2d(dtype=wp.float32)
    inverse: wp.array2d(dtype=wp.float32)
    slope_u: wp.array2d(dtype=wp.float32)
    slope_v: wp.array2d(dtype=wp.float32)
    rim: wp.array2d(dtype=wp.float32)
    left: wp.array2d(dtype=wp.int32)
    right: wp.array2d(dtype=wp.int32)
    top: wp.array2d(dtype=wp.int32)
    bottom: wp.array2d(dtype=wp.int32)
    drawn: wp.array2d(dtype=wp.int32)
    num_drawn: wp.array(dtype=wp.int32)


def allocate_discs(batch: int, capacity: int, device: str) -> Discs:
    """Working memory for lists of up to ``capacity`` surfels."""
    discs = Discs()
    for name in ("u", "v", "inverse", "slope_u", "slope_v", "rim"):
        setattr(discs, name, wp.zeros((batch, capacity), dtype=wp.float32, device=device))
    for name in ("left", "right", "top", "bottom", "drawn"):
        setattr(discs, name, wp.zeros((batch, capacity), dtype=wp.int32, device=device))
    discs.num_drawn = wp.zeros(batch, dtype=wp.int32, device=device)
    return discs


@wp.func
def floor_int(x: float) -> int:
    """Largest integer not above x >= -100; truncation is much faster than ``wp.floor``."""
    return int(x + 100.0) - 100


@wp.func
def half_extent(p: wp.vec3, n: wp.vec3, across: float, tilt: float, radius: float, focal: float):
    """How far a disc at p reaches from its centre in columns or rows.

    A tilted disc is an ellipse: an offset d in its plane moves the column by (f / z) a . d with
    a = (1, 0, -x / z), at most |d| times a's part in the plane. ``across`` is x or y, ``tilt`` the
    normal's component there. The twentieth part more allows for perspective.
    """
    ratio = across / p[2]
    part = tilt - ratio * n[2]
    in_plane = wp.sqrt(wp.max(1.0 + ratio * ratio - part * part, 0.0))
    return 1.05 * focal * radius / p[2] * in_plane


@wp.func
def drawn_radius(radius: float, z: float, camera: SplatCamera):
    """Radius in metres after the limits in pixels."""
    pixel = z / camera.focal[0]
    return wp.clamp(radius, camera.min_px * pixel, camera.max_px * pixel)


@wp.kernel
def project_discs(visible: VisibleList, camera: SplatCamera, workers: int, discs: Discs) -> None:
    """Footprints of the listed surfels.

    Several short loops without branches: the compiler turns them into operations on many surfels
    at once, which it does not for loops that write many arrays.
    """
    k, worker = wp.tid()
    fx = camera.focal[0]
    fy = camera.focal[1]
    cx = camera.centre[0]
    cy = camera.centre[1]
    share = (visible.count[k] + workers - 1) / workers
    start = worker * share
    end = wp.min(start + share, visible.count[k])
    j = int(start)
    while j < end:
        p = fetch(visible.position, k, j)
        inverse = 1.0 / p[2]
        put(discs.inverse, k, j, inverse)
        put(discs.u, k, j, fx * p[0] * inverse + cx)
        put(discs.v, k, j, fy * p[1] * inverse + cy)
        j += 1
    j = int(start)
    while j < end:
        n = fetch(visible.normal, k, j)
        # n . ray = (n . p) / z for rays with z = 1: inverse depth is (n / (n . p)) . ray.
        plane = 1.0 / wp.min(wp.dot(n, fetch(visible.position, k, j)), -1.0e-6)
        put(discs.slope_u, k, j, n[0] * plane / fx)
        put(discs.slope_v, k, j, n[1] * plane / fy)
        j += 1
    j = int(start)
    while j < end:
        z = fetch(visible.position, k, j)[2]
        radius = drawn_radius(fetch(visible.radius, k, j), z, camera)
        put(discs.rim, k, j, radius * radius)
        j += 1
    j = int(start)
    while j < end:
        p = fetch(visible.position, k, j)
        n = fetch(visible.normal, k, j)
        radius = drawn_radius(fetch(visible.radius, k, j), p[2], camera)
        reach = half_extent(p, n, p[0], n[0], radius, fx)
        u = fx * p[0] / p[2] + cx
        put(discs.left, k, j, wp.max(floor_int(u - reach) + 1, 0))
        put(discs.right, k, j, wp.min(floor_int(u + reach), camera.width - 1))
        j += 1
    j = int(start)
    while j < end:
        p = fetch(visible.position, k, j)
        n = fetch(visible.normal, k, j)
        radius = drawn_radius(fetch(visible.radius, k, j), p[2], camera)
        reach = half_extent(p, n, p[1], n[1], radius, fy)
        v = fy * p[1] / p[2] + cy
        put(discs.top, k, j, wp.max(floor_int(v - reach) + 1, 0))
        put(discs.bottom, k, j, wp.min(floor_int(v + reach), camera.height - 1))
        j += 1
