"""The surfels of B maps and their bookkeeping, as structures of device arrays."""

from __future__ import annotations

from typing import Any

from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env._runtime.warp import roomy_zeros
from ms_slam_env.errors import InputError

BLOCK_SIZE = wp.constant(128)
"""Number of surfels in a culling block."""
NUM_AGES = 256
"""Number of age bins for the unstable surfels of a crowded map."""
EARLIEST = -(2**31)
LATEST = 2**31 - 1
"""Bounds of a ``SeenWindow`` that excludes nothing."""
GPU_THREADS = 1 << 20  # approximate number per launch
GPU_WORKERS = (256, 8192)  # fewest and most that share one env's surfels


@wp.struct
class Surfels:
    """Discs in the world frame; slots ``count[b]`` and later of env b are free.

    A surfel with confidence 0 is dead: it keeps its slot until the next compaction.
    """

    position: wp.array2d[wp.vec3]
    normal: wp.array2d[wp.vec3]
    color: wp.array2d[wp.vec3]
    radius: wp.array2d[wp.float32]
    confidence: wp.array2d[wp.float32]
    created: wp.array2d[wp.int32]
    seen: wp.array2d[wp.int32]
    count: wp.array[wp.int32]
    dead: wp.array[wp.int32]
    dropped: wp.array[wp.int32]


COUNTERS = ("count", "dead", "dropped")
"""Arrays (B,) of ``Surfels``."""
ATTRIBUTES = ("position", "normal", "color", "radius", "confidence", "created", "seen")
"""Arrays (B, capacity) of ``Surfels``."""


@wp.struct
class VisibleList:
    """Surfels inside the frustum of one camera per env, with their camera-frame geometry."""

    index: wp.array2d[wp.int32]
    position: wp.array2d[wp.vec3]
    normal: wp.array2d[wp.vec3]
    radius: wp.array2d[wp.float32]
    count: wp.array[wp.int32]


@wp.struct
class CullingBlocks:
    """Blocks of B maps: arrays (B, capacity / BLOCK_SIZE, rounded up)."""

    low: wp.array2d[wp.vec3]  # lower corner of the bounding box, world frame
    high: wp.array2d[wp.vec3]  # upper corner
    # frame that last saw the block's longest unseen unstable surfel; the largest integer if all are
    # stable or dead.
    expiry: wp.array2d[wp.int32]
    listed: wp.array2d[wp.int32]  # blocks that a camera may see
    num_listed: wp.array[wp.int32]  # (B,) number of listed blocks
    bounded: wp.array[wp.int32]  # (B,) number of slots whose blocks have a valid box


@wp.struct
class SplatFootprints:
    """Footprints of a list's surfels in the image, arrays (B, capacity), and the drawn ones."""

    u: wp.array2d[wp.float32]  # column of the centre
    v: wp.array2d[wp.float32]  # row of the centre
    inverse: wp.array2d[wp.float32]  # inverse depth of the centre
    slope_u: wp.array2d[wp.float32]  # change of inverse depth per column
    slope_v: wp.array2d[wp.float32]  # change of inverse depth per row
    rim: wp.array2d[wp.float32]  # squared radius, square metres
    # first column that the disc may cover; ``right``, ``top`` and ``bottom`` likewise.
    left: wp.array2d[wp.int32]
    right: wp.array2d[wp.int32]  # last column
    top: wp.array2d[wp.int32]  # first row
    bottom: wp.array2d[wp.int32]  # last row
    drawn: wp.array2d[wp.int32]  # list indices of the discs that may cover a pixel
    num_drawn: wp.array[wp.int32]  # (B,) number of these discs


@wp.struct
class Compaction:
    """Working memory of ``surfel_map``."""

    survivors: wp.array2d[wp.int32]  # (B, capacity) slots to keep
    kept: wp.array[wp.int32]  # (B,) number of survivors, -1 if no compaction is due
    expired: wp.array[wp.int32]  # (B,) surfels that died just now


@wp.struct
class SurfelAges:
    """Age histogram of the unstable surfels of crowded maps, see ``surfel_map``."""

    count: wp.array2d[wp.int32]  # (B, NUM_AGES), the oldest first


@wp.struct
class SeenWindow:
    """Selects surfels of B maps by the frame that last saw them."""

    seen_from: wp.array[wp.int32]  # (B,) first frame
    seen_to: wp.array[wp.int32]  # (B,) last frame


def any_time(batch: int, device: str) -> SeenWindow:
    """Window that excludes no surfel of ``batch`` maps."""
    window = SeenWindow()
    window.seen_from = wp.full(batch, EARLIEST, dtype=wp.int32, device=device)
    window.seen_to = wp.full(batch, LATEST, dtype=wp.int32, device=device)
    return window


def allocate(struct: Any, batch: int, size: int, device: str) -> Any:
    """Allocate zeros for all arrays of a struct: (B, size), or (B,) for one-dimensional ones."""
    arrays = struct()
    for name, member in struct.vars.items():
        shape = (batch, size)[: member.type.ndim]
        setattr(arrays, name, roomy_zeros(shape, member.type.dtype, device))
    return arrays


class MapBuffers:
    """Device arrays of B maps, empty at first, shared by all users of these maps."""

    def __init__(self, batch: int, capacity: int, device: str, workers: int | None = None) -> None:
        """Allocate the arrays.

        Raises:
            InputError: there is not enough memory for ``capacity`` surfels.
        """
        try:
            self._make_room(batch, capacity, device, workers)
        except (OSError, MemoryError, RuntimeError) as error:  # RuntimeError: on a GPU
            raise InputError(f"no memory for a map of max_surfels = {capacity}: {error}") from error

    def _make_room(self, batch: int, capacity: int, device: str, workers: int | None) -> None:
        self.batch, self.capacity, self.device = batch, capacity, device
        self.workers = default_workers(batch, device) if workers is None else workers
        of_surfels = batch, capacity, device
        self.surfels: Surfels = allocate(Surfels, *of_surfels)
        self.blocks: CullingBlocks = allocate(
            CullingBlocks, batch, -(-capacity // BLOCK_SIZE), device
        )
        self.visible: VisibleList = allocate(VisibleList, *of_surfels)  # working list
        self.footprints: SplatFootprints = allocate(SplatFootprints, *of_surfels)  # of such a list
        self._make_compaction()
        self.ages: SurfelAges = allocate(SurfelAges, batch, NUM_AGES, device)
        # Surfels that frames are tracked against and fused into: all, unless its times are set.
        self.active = any_time(batch, device)

    def _make_compaction(self) -> None:
        """Let compaction use the memory of what is listed and drawn, which is made anew later."""
        batch, capacity, device = self.batch, self.capacity, self.device
        listed, drawn, size = self.visible, self.footprints, batch * capacity
        # Three numbers a footprint side by side make room for three colour values a surfel.
        room = self._room = roomy_zeros(3 * size, wp.float32, device)
        for number, name in enumerate(("v", "inverse", "slope_u")):
            part = room[number * size : (number + 1) * size]
            setattr(drawn, name, part.reshape((batch, capacity)))
        self.spare = spare = Surfels()
        spare.position, spare.normal, spare.radius = listed.position, listed.normal, listed.radius
        spare.color = wp.array(ptr=room.ptr, dtype=wp.vec3, shape=(batch, capacity), device=device)
        spare.confidence, spare.created, spare.seen = drawn.u, listed.index, drawn.left
        for name in COUNTERS:
            setattr(spare, name, wp.zeros(batch, dtype=wp.int32, device=device))
        self.compaction = Compaction()
        self.compaction.survivors = drawn.right
        self.compaction.kept = wp.zeros(batch, dtype=wp.int32, device=device)
        self.compaction.expired = wp.zeros(batch, dtype=wp.int32, device=device)


def default_workers(batch: int, device: str) -> int:
    """Number of threads that share one env's surfels; 1 on the CPU, which runs them in turn."""
    if wp.get_device(device).is_cpu:
        return 1
    fewest, most = GPU_WORKERS
    return min(most, max(fewest, GPU_THREADS // batch))


@wp.func
def rotation_of(T: wp.mat44) -> wp.mat33:
    """Rotation part of a rigid motion."""
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def translation_of(T: wp.mat44) -> wp.vec3:
    """Translation part of a rigid motion."""
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def depth_tolerance(distance_at_1m: float, z: float) -> float:
    """Allowed distance between two readings of one surface at depth z, metres.

    The axial noise of a structured-light sensor grows with z squared (Nguyen et al., 3DIMPVT
    2012); the constant part allows for errors of the pose.
    """
    return distance_at_1m * (0.7 + 0.3 * z * z)


@wp.struct
class SplatCamera:
    """Image size, focal lengths (px), principal point (px), and how discs are drawn."""

    width: int  # columns
    height: int  # rows
    focal: wp.vec2  # (fx, fy)
    centre: wp.vec2  # (cx, cy)
    z_near: float  # nearest depth drawn, metres
    z_far: float  # farthest depth drawn, metres
    tolerance_m: float  # discs this far behind the nearest one belong to the same surface (at 1 m)
    min_px: float  # smallest drawn radius
    max_px: float  # largest drawn radius
    max_weight: float  # confidence above which a disc's weight stops growing


@wp.func
def floor_int(x: float) -> int:
    """Largest integer not above x >= -100; truncation is much faster than ``wp.floor``."""
    return int(x + 100.0) - 100
