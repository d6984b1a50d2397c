# mypy: disable-error-code="empty-body"
"""Bounding boxes of blocks of surfels, and when their first unstable surfel is due for removal.

New surfels are appended frame by frame, so those of a block were made close together. A camera
tests the box of a block first: the cost of listing what is in view follows what is near the view,
not what is stored. Boxes of the blocks in view are taken anew after every fusion, which alone moves
surfels a little; other boxes stay as they are. The same holds for the time of removal.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.surfels import BLOCK_SIZE, CullingBlocks, Surfels


@wp.func
def num_blocks(count: int):
    """Blocks that ``count`` slots fill or begin."""
    return (count + BLOCK_SIZE - 1) / BLOCK_SIZE


@wp.func_native(
    """
const size_t start = size_t(b) * surfels.radius.shape[1] + first;
const float* p = (const float*)surfels.position.data + 3 * start;
const float* confidence = surfels.confidence.data + start;
const int* seen = surfels.seen.data + start;
#if defined(__CUDA_ARCH__)
constexpr int WIDE = 3;
#else
constexpr int WIDE = 24;  // the coordinates of eight surfels at a time
#endif
float low[WIDE], high[WIDE];
for (int k = 0; k < WIDE; ++k) low[k] = high[k] = p[k % 3];
int done = 0;
for (; done + WIDE <= 3 * n; done += WIDE) {
    for (int k = 0; k < WIDE; ++k) {
        low[k] = p[done + k] < low[k] ? p[done + k] : low[k];
        high[k] = p[done + k] > high[k] ? p[done + k] : high[k];
    }
}
for (int k = 0; k < WIDE; ++k) {
    const int at = done + k < 3 * n ? done + k : k % 3;
    low[k] = p[at] < low[k] ? p[at] : low[k];
    high[k] = p[at] > high[k] ? p[at] : high[k];
}
for (int k = 3; k < WIDE; ++k) {
    low[k % 3] = low[k] < low[k % 3] ? low[k] : low[k % 3];
    high[k % 3] = high[k] > high[k % 3] ? high[k] : high[k % 3];
}
int expiry = 0x7fffffff;
for (int k = 0; k < n; ++k) {
    const bool is_unstable = (confidence[k] > 0.0f) & (confidence[k] < threshold);
    const int due = is_unstable ? seen[k] : 0x7fffffff;
    expiry = due < expiry ? due : expiry;
}
const size_t block = size_t(b) * blocks.expiry.shape[1] + first / BLOCK_SIZE;
blocks.low.data[block] = wp::vec3(low[0], low[1], low[2]);
blocks.high.data[block] = wp::vec3(high[0], high[1], high[2]);
blocks.expiry.data[block] = expiry;
""".replace("BLOCK_SIZE", str(BLOCK_SIZE))
)
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
