"""How often a trajectory comes back to where it has been."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


def revisits(
    poses: Float64, near_m: float = 1.5, apart_m: float = 20.0, angle_deg: float = 40.0
) -> Bool:
    """Frames (N,) at places that were left and are seen again from about the same side.

    Args:
        poses: T_world_camera (N, 4, 4).
        near_m: an earlier position within this distance,
        apart_m: from which the way has been at least this long,
        angle_deg: with a viewing direction within this angle.
    """
    positions, views = poses[:, :3, 3], poses[:, :3, 2]
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    neighbours = cKDTree(positions).query_ball_point(positions, near_m)
    least = np.cos(np.radians(angle_deg))
    found = np.zeros(len(poses), bool)
    for k, near in enumerate(neighbours):
        earlier = np.array([j for j in near if walked[k] - walked[j] > apart_m], int)
        found[k] = bool(len(earlier)) and bool((views[earlier] @ views[k] > least).any())
    return found


def count_loops(
    poses: Float64, near_m: float = 1.5, apart_m: float = 20.0, angle_deg: float = 40.0
) -> int:
    """Runs of frames that revisit places; runs less than half of ``apart_m`` apart are one."""
    again = revisits(poses, near_m, apart_m, angle_deg)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    where = walked[again]
    return int(len(where) > 0) + int((np.diff(where) > 0.5 * apart_m).sum())
