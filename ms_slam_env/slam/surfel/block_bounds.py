# mypy: disable-error-code="empty-body"
"""Bounding boxes of blocks of surfels, and when their first unstable surfel is due for removal.

New surfels are appended frame by frame, so those of a block were made close together. A camera
tests the box of a block first: the cost of listing what is in view follows what is near the view,
not what is stored. Boxes of the blocks in view are taken anew after every fusion, which alone moves
surfels a little; other boxes stay as they are. The same holds for the time of removal.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import wp
from ms_slam_env.native import native_source
from ms_slam_env.slam.surfel.surfels import BLOCK_SIZE, CullingBlocks, Surfels


@wp.func
def num_blocks(count: int):
    """Blocks that ``count`` slots fill or begin."""
    return (count + BLOCK_SIZE - 1) / BLOCK_SIZE


@wp.func_native(native_source("block_bounds", "bound", BLOCK_SIZE=BLOCK_SIZE))
def bound(surfels: Surfels, blocks: CullingBlocks, b: int, first: int, n: int, threshold: float):
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
    """Note that all boxes hold."""
    b = wp.tid()
    blocks.bounded[b] = wp.min(surfels.count[b], capacity)
