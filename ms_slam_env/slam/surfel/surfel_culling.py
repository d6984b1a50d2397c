"""Kernels that remove surfels and close the gaps they leave.

A removed surfel is dead: it keeps its slot, and nothing sees it. The gaps are closed when they are
many. A crowded map forgets what was not seen for longest, so much at a time that there is room for
some frames, not all that is out of view: it may be all that a camera has mapped.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import wp
from ms_slam_env.slam.surfel.block_bounds import num_blocks
from ms_slam_env.slam.surfel.device import fetch, put
from ms_slam_env.slam.surfel.fusion import FusedFrame
from ms_slam_env.slam.surfel.surfels import (
    BLOCK_SIZE,
    NUM_AGES,
    Compaction,
    CullingBlocks,
    SurfelAges,
    Surfels,
)

NEVER = wp.constant(2**31 - 1)
AGES = wp.constant(NUM_AGES)
FORGOTTEN = wp.constant(16)  # a sixteenth of a crowded map's slots at once


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


@wp.func
def age_span(rule: CullingRule, time: int):
    """Frames that the ages of unstable surfels are counted over."""
    return wp.max(wp.min(rule.window, time), 1)


@wp.kernel
def count_ages(
    surfels: Surfels, rule: CullingRule, frame: FusedFrame, workers: int, ages: SurfelAges
) -> None:
    """Count the unstable surfels of crowded maps by the frame that saw them last."""
    b, worker = wp.tid()
    time = frame.time[b]
    count = wp.min(surfels.count[b], rule.capacity)
    if frame.mask[b] == 0 or not is_crowded(count - surfels.dead[b], rule.capacity):
        return
    span = age_span(rule, time)
    i = int(worker)
    while i < count:
        confidence = fetch(surfels.confidence, b, i)
        seen = fetch(surfels.seen, b, i)
        if confidence > 0.0 and confidence < rule.confidence_threshold and seen < time:
            age = wp.max(seen - (time - span), 0) * AGES / span
            wp.atomic_add(ages.count, b, age, 1)
        i += workers


@wp.func
def oldest_that_stay(ages: SurfelAges, rule: CullingRule, b: int, time: int):
    """The frame from which on unstable surfels stay in a crowded map.

    As many have not been seen since as must go, or all that are not in view.
    """
    gone = wp.int32(0)
    k = wp.int32(0)
    while k < AGES and gone < rule.capacity / FORGOTTEN:
        gone += ages.count[b, k]
        k += 1
    span = age_span(rule, time)
    return time - span + (k * span + AGES - 1) / AGES


@wp.kernel
def cull_unstable(
    surfels: Surfels,
    blocks: CullingBlocks,
    rule: CullingRule,
    frame: FusedFrame,
    workers: int,
    compaction: Compaction,
    ages: SurfelAges,
) -> None:
    """Let the unstable surfels die that were not seen for long, every ``interval`` frames.

    In a map whose living surfels take nine tenths of the slots, at once and whatever their age
    those of them that were not seen for longest: a sixteenth of the slots, if there are so many out
    of view. Only the blocks are looked at that hold such surfels.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], rule.capacity)
    time = frame.time[b]
    crowded = is_crowded(count - surfels.dead[b], rule.capacity)
    if frame.mask[b] == 0 or (time % rule.interval != 0 and not crowded):
        return
    oldest = time - rule.window
    if crowded:
        oldest = oldest_that_stay(ages, rule, b, time)
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
