"""Paths of several robots through one scene, such that they see the same surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sequences import HandheldPath

Float64 = NDArray[np.float64]

VOXEL_M = 0.10
_ATTEMPTS = 30
_SEEDS_A_ROBOT = 1000
_LOOKS = 25  # poses of a path that are looked from
_REACH_M = 4.0  # of the sensor


class Views:
    """Which surface a path sees, as occupied voxels of ``VOXEL_M``."""

    def __init__(self, scene: Scene) -> None:
        """Prepare to look around in a scene."""
        self._sensor = RGBDSensor(scene, xtion("80x60"), noise="none")

    def of(self, poses: Float64) -> set[tuple[int, ...]]:
        """Voxels seen from poses (N, 4, 4)."""
        points = self.points(poses[:: max(1, len(poses) // _LOOKS)], VOXEL_M)
        return set(map(tuple, np.floor(points / VOXEL_M).astype(int).tolist()))

    def points(self, poses: Float64, voxel_m: float) -> Float64:
        """Points (M, 3) of the true surface that poses (N, 4, 4) see, one a voxel."""
        seen = []
        for pose in poses:
            view = self._sensor.ground_truth(pose)
            near = (view.depth > 0) & (view.depth <= _REACH_M)
            seen.append(view.points[near].astype(np.float64))
        return voxel_downsample(np.concatenate(seen), voxel_m)


def overlap(a: set[tuple[int, ...]], b: set[tuple[int, ...]]) -> float:
    """Share of the smaller of two sets of voxels that is in the other too."""
    return len(a & b) / max(1, min(len(a), len(b)))


def team_paths(
    scene: Scene, path: HandheldPath, seed: int, robots: int, least_overlap: float
) -> tuple[list[Float64], list[float]]:
    """A path for each robot, each seeing enough of what one before it sees.

    Args:
        scene: where.
        path: how they are carried.
        seed: of the paths.
        robots: how many.
        least_overlap: share of the smaller set of surfaces seen, [0, 1]; 0 = any path will do.

    Returns:
        paths (N, 4, 4), and for every robot but the first its largest overlap with one before.

    Raises:
        InputError: no free path, or none that overlaps.
    """
    views = Views(scene)
    paths: list[Float64] = []
    seen: list[set[tuple[int, ...]]] = []
    overlaps: list[float] = []
    for robot in range(robots):
        for attempt in range(_ATTEMPTS):
            number = (seed * robots + robot) * _SEEDS_A_ROBOT + attempt
            poses = path.poses(scene, number)
            voxels = views.of(poses)
            shared = max((overlap(voxels, other) for other in seen), default=1.0)
            if shared >= least_overlap:
                break
        else:
            raise InputError(
                f"found no path of robot {robot} in scene {scene.name!r}, seed {scene.seed}, that "
                f"shares {100 * least_overlap:.0f} % of what another sees"
            )
        paths.append(poses)
        seen.append(voxels)
        overlaps.append(shared)
    return paths, overlaps[1:]
