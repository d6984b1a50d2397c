"""Closes loops: recognises a place and corrects the map by a pose graph, with GTSAM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import invert, orthonormal, relative_angle
from ms_slam_env.slam.shared.feature_matching import most_alike
from ms_slam_env.slam.shared.state import Stateful
from ms_slam_env.slam.shared.state_check import ArrayOf
from ms_slam_env.slam.slam_backend import Loop
from ms_slam_env.slam.sparse.local_mapping import load_gtsam
from ms_slam_env.slam.sparse.localization import Fix, LiveFrame, Localizer
from ms_slam_env.slam.sparse.sparse_map import SparseMap

_LOOP_GAP = 10  # least number of keyframes between the two ends of a loop
_FIXED_SIGMA = 1e-6
_ITERATIONS = 20
_CANDIDATES = 3  # keyframes tested per loop search
_SHARED_POINTS = 30  # least for an edge between keyframes
# Tighter than other edges, whose errors add up, and many of which run in parallel.
_LOOP_M, _LOOP_RAD = 0.002, 0.001
_SMALL_M, _SMALL_RAD = 0.003, 0.002  # smaller loop errors need no pose graph


@dataclass(frozen=True)
class Edge:
    """The measured motion between two poses."""

    a: int  # index of the first pose
    b: int  # index of the second pose
    T_a_b: Float64  # (4, 4) motion
    sigma_rad: float = 0.005  # standard deviation of its rotation
    sigma_m: float = 0.01  # standard deviation of its translation


def optimise_poses(poses: Float64, edges: Sequence[Edge], fixed: NDArray[np.bool_]) -> Float64:
    """Least-squares poses (K, 4, 4); ``fixed`` ones (K,) do not move."""
    gtsam = load_gtsam()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    stay = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    for index, pose in enumerate(poses):
        value = gtsam.Pose3(pose)
        values.insert(index, value)
        if fixed[index]:
            graph.add(gtsam.PriorFactorPose3(index, value, stay))
    for edge in edges:
        sigmas = np.array([edge.sigma_rad] * 3 + [edge.sigma_m] * 3)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.BetweenFactorPose3(edge.a, edge.b, gtsam.Pose3(edge.T_a_b), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    optimised = poses.copy()
    for free in np.flatnonzero(~fixed).tolist():
        optimised[free] = orthonormal(result.atPose3(free).matrix())
    return optimised


class LoopCloser(Stateful):
    """Closes loops in a map."""

    def __init__(self, sparse_map: SparseMap, localizer: Localizer) -> None:
        self._map = sparse_map
        self._localizer = localizer
        self.edges: list[Edge] = []  # of all loops closed so far

    def close(self, keyframe: int, frame: LiveFrame) -> Loop | None:
        """Close a loop at the keyframe made of ``frame``; None if there is none."""
        for candidate in self._candidates(keyframe):
            T = self._localizer.by_looks(frame, candidate)
            fix = None if T is None else self._localizer.near(frame, T, candidate)
            if fix is None or self._localizer.verify(fix, frame).reason:
                continue
            return self._join(keyframe, fix)
        return None

    def _candidates(self, keyframe: int) -> list[int]:
        """Old keyframes that look similar but do not share its points already."""
        old = keyframe - _LOOP_GAP
        if old < 1:
            return []
        frames = self._map.keyframes
        known = self._map.neighbours(keyframe, len(frames))
        near = {k for of_one in self._map.neighbours_of_each(known, 10) for k in of_one}
        near.update(known)
        rest = [k for k in range(old) if k not in near]
        looks = [frames[k].thumbnail for k in rest]
        alike = most_alike(frames[keyframe].thumbnail, looks, _CANDIDATES)
        return [rest[index] for index in alike]

    def _join(self, keyframe: int, fix: Fix) -> Loop:
        """Correct the trajectory to close the loop, then merge the points seen at both ends."""
        frames = self._map.keyframes
        known = frames[fix.reference].T_world_camera
        motion = invert(known) @ fix.T_world_camera
        error = invert(frames[keyframe].T_world_camera) @ fix.T_world_camera
        self.edges.append(Edge(fix.reference, keyframe, motion, _LOOP_RAD, _LOOP_M))
        is_off = (
            np.linalg.norm(error[:3, 3]) > _SMALL_M
            or relative_angle(np.eye(3), error[:3, :3]) > _SMALL_RAD
        )
        if is_off:
            self._bend()
        self._share_points(keyframe, fix)
        return Loop(frames[fix.reference].frame, motion, bool(is_off))

    def _bend(self) -> None:
        frames = self._map.keyframes
        poses = np.stack([frame.T_world_camera for frame in frames])
        fixed = np.array([frame.known for frame in frames])
        if not fixed.any():
            fixed[0] = True
        optimised = optimise_poses(poses, [*self._edges_of(poses), *self.edges], fixed)
        moved = np.flatnonzero((optimised != poses).any(axis=(1, 2)))
        self._map.move({int(k): optimised[k] for k in moved})

    def _edges_of(self, poses: Float64) -> list[Edge]:
        """Current motions between consecutive keyframes, and between those that share points."""
        edges = []
        closed = {frozenset((edge.a, edge.b)) for edge in self.edges}
        near = self._map.neighbours_of_each(range(len(poses)), 10, _SHARED_POINTS)
        for b in range(1, len(poses)):
            for a in sorted({b - 1, *(k for k in near[b] if k < b)}):
                if frozenset((a, b)) not in closed:
                    edges.append(Edge(a, b, invert(poses[a]) @ poses[b]))
        return edges

    def _share_points(self, keyframe: int, fix: Fix) -> None:
        """Merge the keyframe's points with the old points that it also shows."""
        end = self._map.keyframes[keyframe]
        is_corner = (fix.features >= 0) & ~np.isin(fix.point_ids, end.seen_points())
        features, theirs = fix.features[is_corner], fix.point_ids[is_corner]
        mine = end.point_ids[features]
        new = mine < 0
        end.point_ids[features[new]] = theirs[new]
        self._map.merge(theirs[~new], mine[~new])

    def get_state(self) -> dict[str, Any]:
        """The loops closed so far."""
        return {
            "ends": np.array([(edge.a, edge.b) for edge in self.edges], np.int64).reshape(-1, 2),
            "motions": np.array([edge.T_a_b for edge in self.edges]).reshape(-1, 4, 4),
        }

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return {
            "ends": ArrayOf(np.int64, ("loops", 2), least=0, index_of="keyframes"),
            "motions": ArrayOf(np.float64, ("loops", 4, 4)),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        ends = state["ends"].tolist()
        self.edges = [
            Edge(a, b, T.copy(), _LOOP_RAD, _LOOP_M)
            for (a, b), T in zip(ends, state["motions"], strict=True)
        ]
