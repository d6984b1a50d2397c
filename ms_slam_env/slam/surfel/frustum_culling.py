# mypy: disable-error-code="empty-body"
"""Find the surfels that a camera may see: test bounding boxes of blocks first, then surfels.

New surfels are appended frame by frame, so those of a block are close together. Testing boxes first
makes the cost of culling follow the number of surfels near the view, not in the map. Only fusion
moves surfels, and little; so after every fusion the boxes of the blocks in view are computed again
and the others are kept. The same holds for the time of removal.
"""

from __future__ import annotations

import math

from ms_slam_env._runtime.warp import RecordedLaunch
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.native import native_source
from ms_slam_env.slam.surfel.device import fetch, put
from ms_slam_env.slam.surfel.surfels import (
    BLOCK_SIZE,
    CullingBlocks,
    MapBuffers,
    SeenWindow,
    SplatCamera,
    Surfels,
    VisibleList,
    any_time,
    rotation_of,
    translation_of,
)


@wp.func
def num_blocks(count: int) -> int:
    """Blocks that ``count`` slots fill or begin."""
    return (count + BLOCK_SIZE - 1) / BLOCK_SIZE


@wp.func_native(native_source("block_bounds", "bound", BLOCK_SIZE=BLOCK_SIZE))
def bound(
    surfels: Surfels, blocks: CullingBlocks, b: int, first: int, n: int, threshold: float
) -> None:
    """Set box and expiry of the block of the ``n`` surfels from ``first`` on."""


@wp.kernel
def bound_blocks(
    surfels: Surfels, blocks: CullingBlocks, capacity: int, threshold: float, workers: int
) -> None:
    """Take anew the boxes of the listed blocks and of all whose slots are not bounded yet.

    A second launch, ``set_bounded``, must follow.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], capacity)
    fresh = blocks.bounded[b] / BLOCK_SIZE
    j = int(worker)
    while j < blocks.num_listed[b]:
        block = blocks.listed[b, j]
        first = block * BLOCK_SIZE
        if block < fresh and first < count:
            bound(surfels, blocks, b, first, wp.min(BLOCK_SIZE, count - first), threshold)
        j += workers
    block = fresh + worker
    while block < num_blocks(count):
        first = block * BLOCK_SIZE
        bound(surfels, blocks, b, first, wp.min(BLOCK_SIZE, count - first), threshold)
        block += workers


@wp.kernel
def set_bounded(surfels: Surfels, blocks: CullingBlocks, capacity: int) -> None:
    """Mark all boxes as valid."""
    b = wp.tid()
    blocks.bounded[b] = wp.min(surfels.count[b], capacity)


@wp.struct
class Frustum:
    """What a camera sees, in its own frame: x between ``low_u`` z and ``high_u`` z, y likewise."""

    R: wp.mat33
    t: wp.vec3
    low_u: float
    high_u: float
    low_v: float
    high_v: float
    z_near: float
    z_far: float
    focal: float  # px
    layers: float  # surfaces of discs that are enough; infinite: all are listed


@wp.func
def frustum_of(T_world_camera: wp.mat44, camera: SplatCamera, margin_px: float) -> Frustum:
    """Frustum of a camera's image with a margin around."""
    frustum = Frustum()
    frustum.R = wp.transpose(rotation_of(T_world_camera))
    frustum.t = -(frustum.R * translation_of(T_world_camera))
    frustum.low_u = (-0.5 - margin_px - camera.centre[0]) / camera.focal[0]
    frustum.high_u = (float(camera.width) - 0.5 + margin_px - camera.centre[0]) / camera.focal[0]
    frustum.low_v = (-0.5 - margin_px - camera.centre[1]) / camera.focal[1]
    frustum.high_v = (float(camera.height) - 0.5 + margin_px - camera.centre[1]) / camera.focal[1]
    frustum.z_near = camera.z_near
    frustum.z_far = camera.z_far
    frustum.focal = camera.focal[0]
    frustum.layers = wp.inf
    return frustum


@wp.func_native(native_source("frustum_culling", "list_some_visible_blocks"))
def list_some_visible_blocks(
    blocks: CullingBlocks, b: int, first: int, end: int, frustum: Frustum, row: int
) -> int:
    """List the blocks from ``first`` on that reach into a frustum; return the number tested.

    A block is left out only if its box lies entirely outside one plane of the frustum.
    """


@wp.kernel
def list_visible_blocks(
    surfels: Surfels,
    blocks: CullingBlocks,
    first_env: int,
    poses: wp.array[wp.mat44],
    camera: SplatCamera,
    margin_px: float,
    workers: int,
) -> None:
    """List the blocks with a surfel that the camera may see, for ``cull``.

    ``poses[k]`` is T_world_camera of env ``first_env + k``; its list is the k-th.
    """
    k, worker = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    count = num_blocks(surfels.count[b])
    block = int(worker)
    while block < count:
        end = wp.where(workers == 1, count, block + 1)
        tested = list_some_visible_blocks(blocks, b, block, end, frustum, k)
        block += wp.where(workers == 1, tested, workers)


@wp.func_native(native_source("frustum_culling", "list_some_visible"))
def list_some_visible(
    surfels: Surfels,
    b: int,
    first: int,
    end: int,
    frustum: Frustum,
    seen_from: int,
    seen_to: int,
    row: int,
    visible: VisibleList,
) -> int:
    """List the visible surfels from ``first`` on; return the number tested.

    The CPU tests several at a time, at most to ``end``; a GPU thread tests one.

    One surface takes about 1 / r^2 discs of radius r pixels per pixel. If ``layers`` of the frustum
    is finite, a disc is listed with probability ``layers`` r^2, decided by its slot in the map and
    so the same every time.
    """


@wp.kernel
def cull(
    surfels: Surfels,
    blocks: CullingBlocks,
    first_env: int,
    poses: wp.array[wp.mat44],
    camera: SplatCamera,
    margin_px: float,
    workers: int,
    layers: float,
    window: SeenWindow,
    visible: VisibleList,
) -> None:
    """List the living surfels of a window in front of the camera, facing it, within its frustum.

    Those of the blocks that ``list_visible_blocks`` listed; ``poses[k]`` is T_world_camera of env
    ``first_env + k``. For a single worker, as on the CPU; where many share an env,
    ``count_visible`` and ``place_visible`` make the same list. Of more than ``layers`` surfaces of
    discs so many are left.
    """
    k = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    frustum.layers = layers
    count = surfels.count[b]
    seen_from = window.seen_from[b]
    seen_to = window.seen_to[b]
    for block in range(blocks.num_listed[k]):
        i = int(blocks.listed[k, block] * BLOCK_SIZE)
        end = wp.min(i + BLOCK_SIZE, count)
        while i < end:
            i += list_some_visible(surfels, b, i, end, frustum, seen_from, seen_to, k, visible)


# Many workers count first, so that each knows the places of its surfels: a counter that all of them
# raise would take ten times as long, and put the list in another order every time.

TOGETHER = wp.constant(4)  # neighbours that one thread looks at
PER_BLOCK = wp.constant(BLOCK_SIZE // 4)


@wp.kernel
def mark_blocks(blocks: CullingBlocks, workers: int, starts: wp.array2d[wp.int32]) -> None:
    """Count the listed blocks, each after its own place in ``starts`` (E, blocks + 1)."""
    k, worker = wp.tid()
    j = int(worker)
    while j < blocks.num_listed[k]:
        starts[k, blocks.listed[k, j] + 1] = 1
        j += workers


@wp.kernel
def order_blocks(blocks: CullingBlocks, workers: int, starts: wp.array2d[wp.int32]) -> None:
    """List the blocks in the order of the map, by the running sum of what was marked."""
    k, worker = wp.tid()
    block = int(worker)
    while block < starts.shape[1] - 1:
        if starts[k, block + 1] > starts[k, block]:
            blocks.listed[k, starts[k, block] - starts[k, 0]] = block
        block += workers


@wp.func
def turned(R: wp.mat33, p: wp.vec3, row: int) -> float:
    """Component of R p, with the sums of ``list_some_visible``."""
    return R[row, 0] * p[0] + R[row, 1] * p[1] + R[row, 2] * p[2]


@wp.func
def in_camera(frustum: Frustum, p: wp.vec3) -> wp.vec3:
    """A point in the camera's frame."""
    x = turned(frustum.R, p, 0) + frustum.t[0]
    y = turned(frustum.R, p, 1) + frustum.t[1]
    return wp.vec3(x, y, turned(frustum.R, p, 2) + frustum.t[2])


@wp.func
def facing(frustum: Frustum, n: wp.vec3) -> wp.vec3:
    """A normal in the camera's frame."""
    return wp.vec3(turned(frustum.R, n, 0), turned(frustum.R, n, 1), turned(frustum.R, n, 2))


@wp.func
def is_visible(
    surfels: Surfels, b: int, i: int, frustum: Frustum, seen_from: int, seen_to: int
) -> bool:
    """Whether ``list_some_visible`` lists surfel i."""
    p = in_camera(frustum, fetch(surfels.position, b, i))
    x, y, z = p[0], p[1], p[2]
    inside = z > frustum.z_near and z < frustum.z_far
    inside = inside and x > frustum.low_u * z and x < frustum.high_u * z
    inside = inside and y > frustum.low_v * z and y < frustum.high_v * z
    seen = fetch(surfels.seen, b, i)
    inside = inside and fetch(surfels.confidence, b, i) > 0.0
    inside = inside and seen >= seen_from and seen <= seen_to
    if inside:
        n = facing(frustum, fetch(surfels.normal, b, i))
        inside = n[0] * x + n[1] * y + n[2] * z < 0.0
    if inside and frustum.layers < wp.inf:
        radius_px = fetch(surfels.radius, b, i) * frustum.focal / z
        draw = float((wp.uint32(i) * wp.uint32(2654435769)) >> wp.uint32(8)) / 16777216.0
        inside = draw < frustum.layers * radius_px * radius_px
    return inside


@wp.func
def first_of(blocks: CullingBlocks, k: int, part: int) -> int:
    """First of the surfels that thread ``part`` of those over the listed blocks looks at."""
    block = part / PER_BLOCK
    return blocks.listed[k, block] * BLOCK_SIZE + (part - block * PER_BLOCK) * TOGETHER


@wp.kernel
def count_visible(
    surfels: Surfels,
    blocks: CullingBlocks,
    first_env: int,
    poses: wp.array[wp.mat44],
    camera: SplatCamera,
    margin_px: float,
    workers: int,
    layers: float,
    window: SeenWindow,
    starts: wp.array2d[wp.int32],  # (E, parts + 1), zeros
) -> None:
    """Count what ``cull`` would list of every part of the listed blocks, after the part's place."""
    k, worker = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    frustum.layers = layers
    count = surfels.count[b]
    part = int(worker)
    while part < blocks.num_listed[k] * PER_BLOCK:
        first = first_of(blocks, k, part)
        found = wp.int32(0)
        for i in range(first, wp.min(first + TOGETHER, count)):
            if is_visible(surfels, b, i, frustum, window.seen_from[b], window.seen_to[b]):
                found += 1
        starts[k, part + 1] = found
        part += workers


@wp.kernel
def place_visible(
    surfels: Surfels,
    blocks: CullingBlocks,
    first_env: int,
    poses: wp.array[wp.mat44],
    camera: SplatCamera,
    margin_px: float,
    workers: int,
    layers: float,
    window: SeenWindow,
    starts: wp.array2d[wp.int32],
    visible: VisibleList,
) -> None:
    """List them in the order of the map, by the running sum of what was counted."""
    k, worker = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    frustum.layers = layers
    count = surfels.count[b]
    parts = blocks.num_listed[k] * PER_BLOCK
    if worker == 0:
        visible.count[k] = starts[k, parts] - starts[k, 0]
    part = int(worker)
    while part < parts:
        first = first_of(blocks, k, part)
        place = starts[k, part] - starts[k, 0]
        if starts[k, part + 1] > starts[k, part]:
            for i in range(first, wp.min(first + TOGETHER, count)):
                if is_visible(surfels, b, i, frustum, window.seen_from[b], window.seen_to[b]):
                    p = in_camera(frustum, fetch(surfels.position, b, i))
                    put(visible.index, k, place, i)
                    put(visible.position, k, place, p)
                    put(visible.normal, k, place, facing(frustum, fetch(surfels.normal, b, i)))
                    put(visible.radius, k, place, fetch(surfels.radius, b, i))
                    place += 1
        part += workers


class FrustumCuller:
    """Lists the surfels that cameras can see, one camera for each of ``envs`` maps.

    Only those last seen within ``window``, whose times may be set anew at any moment; None: all.
    """

    def __init__(
        self, buffers: MapBuffers, envs: int, camera: SplatCamera, window: SeenWindow | None = None
    ) -> None:
        self._buffers = buffers
        window = window or any_time(buffers.batch, buffers.device)
        none = wp.zeros(envs, dtype=wp.mat44, device=buffers.device)
        shared = [buffers.surfels, buffers.blocks, 0, none, camera, 0.0]
        shared.append(buffers.workers)
        dim, device = (envs, buffers.workers), buffers.device
        self._blocks = [RecordedLaunch(list_visible_blocks, dim, shared, device)]
        rule = [*shared, math.inf, window]
        if buffers.workers == 1:
            self._surfels = [RecordedLaunch(cull, envs, [*rule, buffers.visible], device)]
            return
        num = buffers.blocks.listed.shape[1]
        spare = buffers.footprints  # which nobody needs until what is listed here is drawn
        self._block_starts = spare.left.flatten()[: envs * (num + 1)].reshape((envs, num + 1))
        size = envs, num * int(PER_BLOCK) + 1
        self._starts = spare.right.flatten()[: math.prod(size)].reshape(size)
        marks = [buffers.blocks, buffers.workers, self._block_starts]
        self._blocks += [
            RecordedLaunch(kernel, dim, marks, device) for kernel in (mark_blocks, order_blocks)
        ]
        self._surfels = [
            RecordedLaunch(count_visible, dim, [*rule, self._starts], device),
            RecordedLaunch(place_visible, dim, [*rule, self._starts, buffers.visible], device),
        ]

    def __call__(
        self,
        poses: wp.array,
        first_env: int = 0,
        margin_px: float = 0.0,
        layers: float = math.inf,
    ) -> None:
        """Fill the list for ``poses`` (envs,) T_world_camera of the envs from ``first_env`` on."""
        self.list_blocks(poses, first_env, margin_px)
        for launch in self._surfels:
            launch.set_param("layers", layers)
        if self._buffers.workers == 1:
            self._buffers.visible.count.zero_()
            self._surfels[0].launch()
        else:
            self._summed(self._starts, *self._surfels)

    def list_blocks(self, poses: wp.array, first_env: int = 0, margin_px: float = 0.0) -> None:
        """List only the blocks of which a surfel may be seen."""
        self._buffers.blocks.num_listed.zero_()
        for launch in (self._blocks[0], *self._surfels):
            launch.set_param("first_env", first_env)
            launch.set_param("poses", poses)
            launch.set_param("margin_px", margin_px)
        self._blocks[0].launch()
        if self._buffers.workers > 1:
            self._summed(self._block_starts, *self._blocks[1:])

    def _summed(self, starts: wp.array, count: RecordedLaunch, place: RecordedLaunch) -> None:
        """Count, sum up, and place what was counted."""
        starts.zero_()
        count.launch()
        flat = starts.flatten()
        wp.utils.array_scan(flat, flat, inclusive=True)
        place.launch()
