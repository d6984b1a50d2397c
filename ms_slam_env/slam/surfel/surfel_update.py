# mypy: disable-error-code="empty-body"
# ruff: noqa: UP018, RUF046
"""The half of fusion that averages the map's surfels with a frame's readings.

On the CPU the work on a surfel is some hundred operations with few decisions: one surfel after the
other takes several times as long as eight at a time. So the rule is written as short loops over a
few surfels, whose intermediate values are local arrays: the compiler turns those without branches
into operations on eight surfels. On a GPU every thread takes one surfel at a time, and the loops
and arrays vanish.

A CPU also waits for memory. There the surfels of a few blocks are culled and updated before the
next ones are looked at, so that they are fetched once.
"""

from __future__ import annotations

from ms_slam_env._runtime.warp import wp
from ms_slam_env.native import native_source
from ms_slam_env.slam.surfel.frustum_culling import frustum_of, list_some_visible
from ms_slam_env.slam.surfel.fusion import COARSER, STEEPEST, FusedFrame, FusionParameters
from ms_slam_env.slam.surfel.surfels import (
    BLOCK_SIZE,
    CullingBlocks,
    SeenWindow,
    SplatCamera,
    Surfels,
    VisibleList,
)

TOGETHER = wp.constant(8)  # blocks that are culled before their surfels are updated


@wp.func_native(native_source("surfel_update", "update_some", STEEPEST=STEEPEST, COARSER=COARSER))
def update_some(
    surfels: Surfels,
    visible: VisibleList,
    b: int,
    first: int,
    end: int,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
) -> int:
    """Update the listed surfels from ``first`` on, at most to ``end``; how many those were."""


@wp.kernel
def update_surfels(
    surfels: Surfels,
    visible: VisibleList,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
    workers: int,
) -> None:
    """Average each visible surfel with the readings about its projection; mark covered pixels.

    A surfel in front of all four readings contradicts free space, one on a reading of what moves
    was mapped before it was known to move, one whose normal disagrees contradicts the surface: all
    lose confidence and die at zero.
    """
    b, worker = wp.tid()
    if frame.mask[b] == 0:
        return
    count = visible.count[b]
    j = int(worker)
    while j < count:
        end = wp.where(workers == 1, count, j + 1)
        updated = update_some(surfels, visible, b, j, end, camera, parameters, frame)
        j += wp.where(workers == 1, updated, workers)


@wp.kernel
def cull_and_update(
    surfels: Surfels,
    blocks: CullingBlocks,
    window: SeenWindow,
    visible: VisibleList,
    camera: SplatCamera,
    parameters: FusionParameters,
    frame: FusedFrame,
) -> None:
    """``cull`` and ``update_surfels`` in turns, a few blocks at a time; for a single worker.

    The list is working memory: what it holds in the end is of no use.
    """
    b = wp.tid()
    if frame.mask[b] == 0:
        return
    frustum = frustum_of(frame.poses[b], camera, 0.0)
    seen_from = window.seen_from[b]
    seen_to = window.seen_to[b]
    num_listed = blocks.num_listed[b]
    start = int(0)
    while start < num_listed:
        visible.count[b] = 0
        for k in range(start, wp.min(start + TOGETHER, num_listed)):
            first = int(blocks.listed[b, k] * BLOCK_SIZE)
            end = wp.min(first + BLOCK_SIZE, surfels.count[b])
            while first < end:
                first += list_some_visible(
                    surfels, b, first, end, frustum, seen_from, seen_to, b, visible
                )
        count = visible.count[b]
        j = int(0)
        while j < count:
            j += update_some(surfels, visible, b, j, count, camera, parameters, frame)
        start += TOGETHER
