"""Kernels that remove surfels and close the gaps they leave."""

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.memory import fetch, put
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
    i = int(worker)
    while i < count:
        confidence = fetch(surfels.confidence, b, i)
        seen = fetch(surfels.seen, b, i)
        if confidence >= confidence_threshold or (confidence > 0.0 and seen >= oldest):
            put(survivors, b, wp.atomic_add(kept, b, 1), i)
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
def gather(
    source: Surfels,
    target: Surfels,
    survivors: wp.array2d(dtype=wp.int32),
    kept: wp.array(dtype=wp.int32),
    workers: int,
) -> None:
    """Copy the survivors that must move to their new slots in ``target``."""
    b, worker = wp.tid()
    count = kept[b]
    j = int(worker)
    while j < count:
        i = fetch(survivors, b, j)
        if i != j:
            copy_surfel(source, target, b, i, j)
        j += workers


@wp.kernel
def put_back(
    source: Surfels,
    target: Surfels,
    survivors: wp.array2d(dtype=wp.int32),
    kept: wp.array(dtype=wp.int32),
    capacity: int,
    workers: int,
) -> None:
    """Copy the gathered survivors back and set the counters."""
    b, worker = wp.tid()
    count = kept[b]
    j = int(worker)
    while j < count:
        if fetch(survivors, b, j) != j:
            copy_surfel(source, target, b, j, j)
        j += workers
    if worker == 0:
        target.count[b] = wp.min(target.count[b], capacity)
        if count >= 0:
            target.count[b] = count
            target.dead[b] = 0
