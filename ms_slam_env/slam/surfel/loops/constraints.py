"""Which points of the map a closed loop moves, and which it holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import transform_points
from ms_slam_env.slam.surfel.loops.energy import Constraints, join

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class VisiblePoints:
    """Surfels in sight of a camera.

    Attributes:
        camera: (N, 3) positions in the camera's frame.
        world: (N, 3) positions in the world.
        times: (N,) when they were created, see ``creation_times``.
    """

    camera: Float64
    world: Float64
    times: Float64

    def take(self, chosen: Int64) -> VisiblePoints:
        """Some of them."""
        return VisiblePoints(self.camera[chosen], self.world[chosen], self.times[chosen])


def creation_times(created: NDArray[np.int32]) -> tuple[Int64, Float64]:
    """Order (N,) of surfels by creation, and their times (N,) in frames, in that order.

    Surfels of one frame are spread over it evenly in the order of their slots, which is that of
    the image's rows: neighbours in time are then neighbours in space too, and the first frame,
    which makes a third of a small map, has as many nodes of the graph as it deserves.
    """
    order = np.argsort(created, kind="stable")
    ordered = created[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))  # of every frame's surfels
    counts = np.diff(starts, append=len(ordered))
    places = np.arange(len(ordered)) - np.repeat(starts, counts)
    times = ordered + places / np.repeat(counts, counts)
    return order.astype(np.int64), times.astype(np.float64)


def choose_points(
    points: VisiblePoints,
    intrinsics: Intrinsics,
    depth: NDArray[np.float32],
    columns: int,
    tolerance_m: float,
) -> Int64:
    """One surfel (M,) for each cell of the image, the nearest to its middle.

    Args:
        points: surfels in sight.
        intrinsics: of ``depth``.
        depth: (H, W) metres of the surface that they must lie on; 0 = leave such pixels out.
        columns: number of cells side by side.
        tolerance_m: how far from the surface, at 1 m; grows with depth squared.
    """
    z = points.camera[:, 2]
    place = intrinsics.project(points.camera)
    u, v = np.floor(place + 0.5).astype(np.int64).T
    inside = (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    inside = np.flatnonzero(inside)
    front = depth[v[inside], u[inside]]
    on_surface = np.abs(z[inside] - front) < tolerance_m * (0.7 + 0.3 * front**2)
    usable = inside[(front > 0) & on_surface]
    cells = (place[usable] + 0.5) / (intrinsics.width / columns)
    off_centre = np.linalg.norm(cells - np.floor(cells) - 0.5, axis=1)
    order = np.argsort(off_centre, kind="stable")
    column, row = np.floor(cells[order]).astype(np.int64).T
    _, firsts = np.unique(row * (columns + 1) + column, return_index=True)
    return usable[order[firsts]]


def surface_constraints(
    active: VisiblePoints, inactive: VisiblePoints, correction: Float64
) -> Constraints:
    """Move points of the active part by ``correction`` (4, 4), hold those of the inactive part."""
    count, pins = len(active.world), len(inactive.world)
    moves = Constraints(
        active.world,
        active.times,
        transform_points(correction, active.world),
        np.full(count, np.nan),
    )
    holds = Constraints(inactive.world, inactive.times, inactive.world, np.full(pins, np.nan))
    return join([moves, holds])


def relative_to(
    constraints: Constraints, active: VisiblePoints, inactive: VisiblePoints
) -> Constraints:
    """The moves among ``surface_constraints`` as relative ones, which later loops must respect.

    A target is as old as the nearest pin.
    """
    count = len(active.world)
    targets = constraints.targets[:count]
    _, nearest = cKDTree(inactive.world).query(targets)
    return Constraints(active.world, active.times, targets, inactive.times[nearest])
