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
    ``first_env + k``. A single worker, as on the CPU, keeps the order of the map. Of more than
    ``layers`` surfaces of discs so many are left.
    """
    k, worker = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    frustum.layers = layers
    count = surfels.count[b]
    seen_from = window.seen_from[b]
    seen_to = window.seen_to[b]
    slots = blocks.num_listed[k] * BLOCK_SIZE
    j = int(worker)
    while j < slots:
        block = j / BLOCK_SIZE
        i = blocks.listed[k, block] * BLOCK_SIZE + j - block * BLOCK_SIZE
        looked_at = 1
        if i < count:
            end = wp.min((i / BLOCK_SIZE + 1) * BLOCK_SIZE, count)
            end = wp.where(workers == 1, end, i + 1)
            looked_at = list_some_visible(
                surfels, b, i, end, frustum, seen_from, seen_to, k, visible
            )
        j += wp.where(workers == 1, looked_at, workers)


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
        self._launches = [
            RecordedLaunch(list_visible_blocks, dim, shared, device),
            RecordedLaunch(cull, dim, [*shared, math.inf, window, buffers.visible], device),
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
        self._launches[1].set_param("layers", layers)
        self._buffers.visible.count.zero_()
        self._launches[1].launch()

    def list_blocks(self, poses: wp.array, first_env: int = 0, margin_px: float = 0.0) -> None:
        """List only the blocks of which a surfel may be seen."""
        self._buffers.blocks.num_listed.zero_()
        for launch in self._launches:
            launch.set_param("first_env", first_env)
            launch.set_param("poses", poses)
            launch.set_param("margin_px", margin_px)
        self._launches[0].launch()
