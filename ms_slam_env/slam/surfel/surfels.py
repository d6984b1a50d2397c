"""The surfels of B maps and what is kept about them, as structures of device arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ms_slam_env._warp import wp

BLOCK_SIZE = wp.constant(128)
"""Surfels of a culling block."""
EARLIEST = -(2**31)
LATEST = 2**31 - 1
"""Bounds of a ``SeenWindow`` that leaves out nothing."""
GPU_THREADS = 1 << 20  # of a launch, about
GPU_WORKERS = (256, 8192)  # fewest and most that share one env's surfels


@wp.struct
class Surfels:
    """Discs in the world frame; slots ``count[b]`` and later of env b are free.

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


COUNTERS = ("count", "dead", "dropped")
"""Arrays (B,) of ``Surfels``."""
ATTRIBUTES = ("position", "normal", "color", "radius", "confidence", "created", "seen")
"""Arrays (B, capacity) of ``Surfels``."""


@wp.struct
class VisibleList:
    """Surfels inside the frustum of one camera per env, with their camera-frame geometry."""

    index: wp.array2d(dtype=wp.int32)
    position: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    radius: wp.array2d(dtype=wp.float32)
    count: wp.array(dtype=wp.int32)


@wp.struct
class CullingBlocks:
    """Blocks of B maps: arrays (B, capacity / BLOCK_SIZE, rounded up).

    Attributes:
        low: lower corner of the bounding box, world frame.
        high: upper corner.
        expiry: frame that saw the block's longest unseen unstable surfel; the largest number if all
            are stable or dead.
        listed: blocks that a camera may see.
        num_listed: (B,) how many those are.
        bounded: (B,) slots whose blocks have a box that holds.
    """

    low: wp.array2d(dtype=wp.vec3)
    high: wp.array2d(dtype=wp.vec3)
    expiry: wp.array2d(dtype=wp.int32)
    listed: wp.array2d(dtype=wp.int32)
    num_listed: wp.array(dtype=wp.int32)
    bounded: wp.array(dtype=wp.int32)


@wp.struct
class SplatFootprints:
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


@wp.struct
class Compaction:
    """Working memory of ``surfel_culling``.

    Attributes:
        survivors: (B, capacity) slots to keep.
        kept: (B,) how many those are, -1 where no compaction is due.
        expired: (B,) surfels that died just now.
    """

    survivors: wp.array2d(dtype=wp.int32)
    kept: wp.array(dtype=wp.int32)
    expired: wp.array(dtype=wp.int32)


@wp.struct
class SeenWindow:
    """Which surfels of B maps take part, by the frame that saw them last.

    Attributes:
        seen_from: (B,) first frame.
        seen_to: (B,) last frame.
    """

    seen_from: wp.array(dtype=wp.int32)
    seen_to: wp.array(dtype=wp.int32)


def any_time(batch: int, device: str) -> SeenWindow:
    """Window that leaves out no surfel of ``batch`` maps."""
    window = SeenWindow()
    window.seen_from = wp.full(batch, EARLIEST, dtype=wp.int32, device=device)
    window.seen_to = wp.full(batch, LATEST, dtype=wp.int32, device=device)
    return window


def allocate(struct: Any, batch: int, size: int, device: str) -> Any:
    """Zeros for all arrays of a struct: (B, size), or (B,) where they have one dimension."""
    arrays = struct()
    for name, member in struct.vars.items():
        shape = (batch, size)[: member.type.ndim]
        setattr(arrays, name, wp.zeros(shape, dtype=member.type.dtype, device=device))
    return arrays


@dataclass(frozen=True)
class MapBuffers:
    """Device arrays of B maps, which all that works on these maps shares.

    Attributes:
        batch: number of maps B.
        capacity: slots of each.
        workers: threads that share one map.
        device: of all arrays.
        surfels: the maps.
        spare: room for compaction.
        blocks: of the surfels.
        visible: working list of the surfels in view.
        footprints: of such a list.
        compaction: working memory.
        active: what frames are tracked against and fused into; all unless its times are set.
    """

    batch: int
    capacity: int
    workers: int
    device: str
    surfels: Surfels
    spare: Surfels
    blocks: CullingBlocks
    visible: VisibleList
    footprints: SplatFootprints
    compaction: Compaction
    active: SeenWindow


def allocate_map(batch: int, capacity: int, device: str, workers: int | None = None) -> MapBuffers:
    """Empty maps of ``batch`` envs with ``capacity`` slots each."""
    structs = (Surfels, VisibleList, SplatFootprints, Compaction)
    surfels, visible, footprints, compaction = (
        allocate(struct, batch, capacity, device) for struct in structs
    )
    return MapBuffers(
        batch=batch,
        capacity=capacity,
        workers=default_workers(batch, device) if workers is None else workers,
        device=device,
        surfels=surfels,
        spare=allocate(Surfels, batch, capacity, device),
        blocks=allocate(CullingBlocks, batch, -(-capacity // BLOCK_SIZE), device),
        visible=visible,
        footprints=footprints,
        compaction=compaction,
        active=any_time(batch, device),
    )


def default_workers(batch: int, device: str) -> int:
    """Threads that share one env's surfels: 1 on the CPU, which runs one after the other."""
    if wp.get_device(device).is_cpu:
        return 1
    fewest, most = GPU_WORKERS
    return min(most, max(fewest, GPU_THREADS // batch))


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
