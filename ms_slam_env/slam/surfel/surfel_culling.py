"""Kernels that remove surfels and close the gaps they leave.

A removed surfel is dead: it keeps its slot, and nothing sees it. The gaps are closed when they are
many.
"""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.block_bounds import num_blocks
from ms_slam_env.slam.surfel.device import fetch, put
from ms_slam_env.slam.surfel.fusion import FusedFrame
from ms_slam_env.slam.surfel.surfels import BLOCK_SIZE, Compaction, CullingBlocks, Surfels

NEVER = wp.constant(2**31 - 1)


@wp.struct
class CullingRule:
    """When surfels go."""

    capacity: int  # slots of a map
    interval: int  # frames between two removals of unstable surfels
    window: int  # frames for which an unstable surfel may stay unseen
    confidence_threshold: float  # at which a surfel is stable


@wp.func
def is_crowded(slots: int, capacity: int):
    """Whether nine tenths of a map's slots are taken."""
    return slots > capacity - capacity / 10


@wp.kernel
def cull_unstable(
    surfels: Surfels,
    blocks: CullingBlocks,
    rule: CullingRule,
    frame: FusedFrame,
    workers: int,
    compaction: Compaction,
) -> None:
    """Let the unstable surfels die that were not seen for long, every ``interval`` frames.

    In a map whose living surfels take nine tenths of the slots, at once and whatever their age
    those that are not in view. Only the blocks are looked at that hold such surfels.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], rule.capacity)
    crowded = is_crowded(count - surfels.dead[b], rule.capacity)
    if frame.mask[b] == 0 or (frame.time[b] % rule.interval != 0 and not crowded):
        return
    oldest = frame.time[b] - wp.where(crowded, 0, rule.window)
    block = int(worker)
    while block < num_blocks(count):
        if blocks.expiry[b, block] < oldest:
            i = block * BLOCK_SIZE
            end = wp.min(i + BLOCK_SIZE, count)
            expiry = int(NEVER)
            while i < end:
                confidence = fetch(surfels.confidence, b, i)
                seen = fetch(surfels.seen, b, i)
                if confidence > 0.0 and confidence < rule.confidence_threshold:
                    if seen < oldest:
                        put(surfels.confidence, b, i, 0.0)
                        wp.atomic_add(compaction.expired, b, 1)
                    else:
                        expiry = wp.min(expiry, seen)
                i += 1
            blocks.expiry[b, block] = expiry
        block += workers


@wp.kernel
def list_survivors(
    surfels: Surfels, rule: CullingRule, frame: FusedFrame, workers: int, compaction: Compaction
) -> None:
    """List the slots to keep of every env whose compaction is due; ``kept`` -1: not due.

    It is due when many slots are dead, so that its cost follows the number of deaths: an eighth, or
    in a crowded map a sixty-fourth and as many as are free.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], rule.capacity)
    dead = surfels.dead[b] + compaction.expired[b]
    many = 8 * dead > count and frame.time[b] % rule.interval == 0
    crowded = is_crowded(count, rule.capacity)
    needed = crowded and 64 * dead > count and dead > rule.capacity - count
    if frame.mask[b] == 0 or not (many or needed):
        compaction.kept[b] = -1
        return
    i = int(worker)
    while i < count:
        if fetch(surfels.confidence, b, i) > 0.0:
            put(compaction.survivors, b, wp.atomic_add(compaction.kept, b, 1), i)
        i += workers


@wp.func
def copy_surfel(source: Surfels, target: Surfels, b: int, i: int, j: int):
    """Copy slot i of one map to slot j of the other."""
    put(target.position, b, j, fetch(source.position, b, i))
    put(target.normal, b, j, fetch(source.normal, b, i))
    put(target.color, b, j, fetch(source.color, b, i))
    put(target.radius, b, j, fetch(source.radius, b, i))
    put(target.confidence, b, j, fetch(source.confidence, b, i))
    put(target.created, b, j, fetch(source.created, b, i))
    put(target.seen, b, j, fetch(source.seen, b, i))


@wp.kernel
def gather(source: Surfels, target: Surfels, compaction: Compaction, workers: int) -> None:
    """Copy the survivors that must move to their new slots in ``target``."""
    b, worker = wp.tid()
    count = compaction.kept[b]
    j = int(worker)
    while j < count:
        i = fetch(compaction.survivors, b, j)
        if i != j:
            copy_surfel(source, target, b, i, j)
        j += workers


@wp.kernel
def put_back(
    source: Surfels,
    target: Surfels,
    blocks: CullingBlocks,
    compaction: Compaction,
    capacity: int,
    workers: int,
) -> None:
    """Copy the gathered survivors back and set the counters."""
    b, worker = wp.tid()
    count = compaction.kept[b]
    j = int(worker)
    while j < count:
        if fetch(compaction.survivors, b, j) != j:
            copy_surfel(source, target, b, j, j)
        j += workers
    if worker == 0:
        target.count[b] = wp.min(target.count[b], capacity)
        target.dead[b] = target.dead[b] + compaction.expired[b]
        if count >= 0:
            target.count[b] = count
            target.dead[b] = 0
            blocks.bounded[b] = 0
