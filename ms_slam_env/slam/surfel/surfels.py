"""The surfels of B maps as structure of arrays, and the small functions that kernels share."""

from __future__ import annotations

from ms_slam_env._warp import wp

ATTRIBUTES = {
    "position": wp.vec3,
    "normal": wp.vec3,
    "color": wp.vec3,
    "radius": wp.float32,
    "confidence": wp.float32,
    "created": wp.int32,
    "seen": wp.int32,
}
"""Arrays (B, capacity) of ``Surfels`` and their types."""
COUNTERS = ("count", "dead", "dropped")
"""Arrays (B,) int32 of ``Surfels``."""


@wp.struct
class Surfels:
    """SplatFootprints in the world frame; slots ``count[b]`` and later of env b are free.

    A surfel with confidence 0 is dead: it keeps its slot until the next compaction.
    """

    position: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    color: wp.array2d(dtype=wp.vec3)
    radius: wp.array2d(dtype=wp.float32)
    confidence: wp.array2d(dtype=wp.float32)
    created: wp.array2d(dtype=wp.int32)
    seen: wp.array2d(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    dead: wp.array(dtype=wp.int32)
    dropped: wp.array(dtype=wp.int32)


@wp.struct
class VisibleList:
    """Surfels inside the frustum of one camera per env, with their camera-frame geometry."""

    index: wp.array2d(dtype=wp.int32)
    position: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    radius: wp.array2d(dtype=wp.float32)
    count: wp.array(dtype=wp.int32)


@wp.struct
class SeenWindow:
    """Which surfels of B maps take part, by the frame that saw them last.

    Attributes:
        seen_from: (B,) first frame.
        seen_to: (B,) last frame.
    """

    seen_from: wp.array(dtype=wp.int32)
    seen_to: wp.array(dtype=wp.int32)


EARLIEST = -(2**31)
LATEST = 2**31 - 1
"""Bounds of a ``SeenWindow`` that leaves out nothing."""


def any_time(batch: int, device: str) -> SeenWindow:
    """Window that leaves out no surfel of ``batch`` maps."""
    window = SeenWindow()
    window.seen_from = wp.full(batch, EARLIEST, dtype=wp.int32, device=device)
    window.seen_to = wp.full(batch, LATEST, dtype=wp.int32, device=device)
    return window


def allocate_surfels(batch: int, capacity: int, device: str) -> Surfels:
    """Empty maps of ``batch`` envs with ``capacity`` slots each."""
    surfels = Surfels()
    for name, dtype in ATTRIBUTES.items():
        setattr(surfels, name, wp.zeros((batch, capacity), dtype=dtype, device=device))
    for name in COUNTERS:
        setattr(surfels, name, wp.zeros(batch, dtype=wp.int32, device=device))
    return surfels


def allocate_visible(batch: int, capacity: int, device: str) -> VisibleList:
    """Empty list of visible surfels."""
    visible = VisibleList()
    visible.index = wp.zeros((batch, capacity), dtype=wp.int32, device=device)
    visible.position = wp.zeros((batch, capacity), dtype=wp.vec3, device=device)
    visible.normal = wp.zeros((batch, capacity), dtype=wp.vec3, device=device)
    visible.radius = wp.zeros((batch, capacity), dtype=wp.float32, device=device)
    visible.count = wp.zeros(batch, dtype=wp.int32, device=device)
    return visible


@wp.func
def rotation_of(T: wp.mat44):
    """Rotation part of a rigid motion."""
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def translation_of(T: wp.mat44):
    """Translation part of a rigid motion."""
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def depth_tolerance(distance_at_1m: float, z: float):
    """Allowed distance between two readings of one surface at depth z, metres.

    The axial noise of a structured-light sensor grows with z squared (Nguyen et al., 3DIMPVT
    2012); the constant part allows for errors of the pose.
    """
    return distance_at_1m * (0.7 + 0.3 * z * z)


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


@wp.func
def floor_int(x: float) -> int:
    """Largest integer not above x >= -100; truncation is much faster than ``wp.floor``."""
    return int(x + 100.0) - 100
