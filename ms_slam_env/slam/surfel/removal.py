"""Kernels that remove surfels and close the gaps they leave."""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.surfel_arrays import Surfels


@wp.kernel
def list_survivors(
    surfels: Surfels,
    capacity: int,
    mask: wp.array(dtype=wp.int32),
    time: wp.array(dtype=wp.int32),
    interval: int,
    confidence_threshold: float,
    window: int,
    workers: int,
    survivors: wp.array2d(dtype=wp.int32),
    kept: wp.array(dtype=wp.int32),
) -> None:
    """List the slots to keep of every env whose compaction is due; ``kept`` -1: not due.

    Compaction is due every ``interval`` frames, and at once when nine tenths of the slots are
    taken; then every surfel that is unstable and not in view goes, whatever its age.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], capacity)
    crowded = count > capacity - capacity / 10
    if mask[b] == 0 or (time[b] % interval != 0 and not crowded):
        kept[b] = -1
        return
    oldest = time[b] - window
    if crowded:
        oldest = time[b]
    for i in range(worker, count, workers):
        confidence = surfels.confidence[b, i]
        if confidence >= confidence_threshold or (
            confidence > 0.0 and surfels.seen[b, i] >= oldest
        ):
            survivors[b, wp.atomic_add(kept, b, 1)] = i


@wp.kernel
def gather(
    source: Surfels,
    target: Surfels,
    survivors: wp.array2d(dtype=wp.int32),
    kept: wp.array(dtype=wp.int32),
    workers: int,
) -> None:
    """Copy the survivors to the front of ``target``."""
    b, worker = wp.tid()
    for j in range(worker, kept[b], workers):
        i = survivors[b, j]
        target.position[b, j] = source.position[b, i]
        target.normal[b, j] = source.normal[b, i]
        target.color[b, j] = source.color[b, i]
        target.radius[b, j] = source.radius[b, i]
        target.confidence[b, j] = source.confidence[b, i]
        target.created[b, j] = source.created[b, i]
        target.seen[b, j] = source.seen[b, i]


@wp.kernel
def put_back(
    source: Surfels,
    target: Surfels,
    kept: wp.array(dtype=wp.int32),
    capacity: int,
    workers: int,
) -> None:
    """Copy the gathered survivors back and set the counters."""
    b, worker = wp.tid()
    for j in range(worker, kept[b], workers):
        target.position[b, j] = source.position[b, j]
        target.normal[b, j] = source.normal[b, j]
        target.color[b, j] = source.color[b, j]
        target.radius[b, j] = source.radius[b, j]
        target.confidence[b, j] = source.confidence[b, j]
        target.created[b, j] = source.created[b, j]
        target.seen[b, j] = source.seen[b, j]
    if worker == 0:
        target.count[b] = wp.min(target.count[b], capacity)
        if kept[b] >= 0:
            target.count[b] = kept[b]
            target.dead[b] = 0
