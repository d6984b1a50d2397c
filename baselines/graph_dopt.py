"""Choose frontiers by the D-optimality of the pose graph, as in ExplORB-SLAM."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from ms_slam_baselines.belief import d_optimality
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.view_goals import frontiers, poses_between, views_of

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import transform_points
from ms_slam_env.planning.view_goals import distance_in_steps

_AWAY_M = 1.2  # distance from which a frontier is viewed
_APART = 3.0  # steps between two keyframes
_SEEN_AGAIN = 0.3  # share of a keyframe's surface in a view that makes an edge between them
_THUMBNAIL = 12  # pixels between sampled points of a keyframe
_START = np.diag([1e-3**2] * 6)  # of the first keyframe, for which SLAM gives no covariance


class Keyframe(NamedTuple):
    """A node of the pose graph."""

    T_world_camera: Float64  # (4, 4)
    surface: Float64  # (n, 3) sampled points in the world; NaN where there is no reading
    weight: float  # D-optimality of the information of its edges


class GraphDOptimality(NextBestView):
    """Goes to the frontier that keeps the pose graph best connected.

    Nodes are keyframes. An edge joins two that see the same surface; its weight is the D-optimality
    of its information. For every frontier, the path to it is added to the graph with its expected
    edges, including hallucinated loop closures; the goal is the frontier with the largest
    D-optimality of the resulting graph (Placed, Gómez-Rodríguez, Tardós, Castellanos,
    "ExplORB-SLAM", ROBOT 2022; Placed, Castellanos, IROS 2021). The planner builds the pose graph
    itself, as dense SLAM has none. Without a frontier, the goal is that of `nbv`. Motions on the
    way are chosen as in `nbv`.

    Args:
        robot: the robot's view.
        seed: for drawing goals where there is no frontier.
        **options: see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def reset(self) -> None:
        """Forget the keyframes."""
        super().reset()
        self.keyframes: list[Keyframe] = []
        self.weights = np.zeros((0, 0))
        """(N, N) weight of the edge from each keyframe to each later one, 0 for none."""

    def act(self, observation: Any, info: dict[str, Any]) -> int:
        """Add a keyframe if the camera has moved on, then act as `nbv`."""
        here = self.robot.T_world_camera_estimate
        if info["tracking_ok"] and self.has_moved_on(here):
            self.weights = extended(self.weights, self.edges_to(here[None]))
            self.keyframes.append(self.keyframe(here))
        return super().act(observation, info)

    def has_moved_on(self, here: Float64) -> bool:
        """Whether no keyframe is near a pose (4, 4)."""
        poses = np.array([k.T_world_camera for k in self.keyframes]).reshape(-1, 4, 4)
        return not (distance_in_steps(poses, here, *self.steps).sum(axis=1) < _APART).any()

    def keyframe(self, here: Float64) -> Keyframe:
        """Make a node of the last frame, taken at a pose (4, 4)."""
        every = (slice(_THUMBNAIL // 2, None, _THUMBNAIL),) * 2
        depth = self.robot.last_frame.depth[every]
        read = np.where(depth > 0, depth, np.nan)
        points = (self.robot.intrinsics.rays()[every] * read[..., None]).reshape(-1, 3)
        covariance = self.robot.pose_covariance
        weight = 1 / max(d_optimality(_START if covariance is None else covariance), 1e-30)
        return Keyframe(here, transform_points(here, points), weight)

    def edges_to(self, way: Float64) -> Float64:
        """Weights (N, P) of the edges from the keyframes to the poses (P, 4, 4) of a path.

        An odometry edge always joins the last keyframe to the first pose.
        """
        if not self.keyframes:
            return np.zeros((0, len(way)))
        surfaces = np.stack([k.surface for k in self.keyframes])
        shares = shares_seen(surfaces, way, self.robot.intrinsics)
        weights = np.array([[k.weight] for k in self.keyframes])
        edges = weights * np.where(shares >= _SEEN_AGAIN, shares, 0)
        edges[-1, 0] = max(edges[-1, 0], _SEEN_AGAIN * weights[-1, 0])
        return edges

    def choose_goal(self, here: Float64) -> Float64:
        """The view (4, 4) of the frontier whose path leaves the graph best connected."""
        grid = self.map.grid
        found = frontiers(grid, here[:3, 3], self.radius_m + _AWAY_M)
        goals = views_of(found, self.ways.positions, here[:3, 3], _AWAY_M)
        goals = goals[self.is_new(goals, here)]
        if not len(goals):
            return super().choose_goal(here)
        return goals[np.argmax([self.connected_by(here, goal) for goal in goals])]

    def connected_by(self, here: Float64, goal: Float64) -> float:
        """D-optimality of the graph with the path from ``here`` to ``goal`` (4, 4) added."""
        steps = distance_in_steps(goal[None], here, *self.steps).max()
        way = poses_between(here, goal, max(1, round(steps / _APART)))
        typical = float(np.median([k.weight for k in self.keyframes]))
        weights = self.weights
        for n, edges in enumerate(self.edges_to(way).T):
            hallucinated = np.zeros(n)
            hallucinated[-1:] = typical
            weights = extended(weights, np.concatenate([edges, hallucinated])[:, None])
        return graph_d_optimality(weights + weights.T)


def extended(weights: Float64, edges: Float64) -> Float64:
    """Extend weights to (N + 1, N + 1) by a new node's edges (N, 1)."""
    grown = np.zeros((len(weights) + 1,) * 2)
    grown[:-1, :-1] = weights
    grown[:-1, -1:] = edges
    return grown


def shares_seen(points: Float64, poses: Float64, intrinsics: Intrinsics) -> Float64:
    """Shares (K, P) of the points (K, n, 3) that lie in the images of cameras at poses (P, 4, 4).

    Points that are NaN do not count.
    """
    T_camera_world = np.linalg.inv(poses)
    inside = points @ T_camera_world[:, :3, :3].reshape(-1, 3).T + T_camera_world[:, :3, 3].ravel()
    x, y, z = np.moveaxis(inside.reshape(*points.shape[:2], -1, 3), -1, 0)
    ahead = np.maximum(z, 1e-6)
    u = intrinsics.fx * x / ahead + intrinsics.cx
    v = intrinsics.fy * y / ahead + intrinsics.cy
    in_image = (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height) & (z > 0)
    known = np.isfinite(points[..., 0]).sum(axis=1)
    return in_image.sum(axis=1) / np.maximum(known, 1)[:, None]


def graph_d_optimality(weights: Float64) -> float:
    """(n t)^(1/n) of a graph of n nodes with symmetric edge weights (n, n).

    t is its weighted number of spanning trees, a cofactor of its Laplacian (Kirchhoff).
    """
    n = len(weights)
    laplacian = np.diag(weights.sum(axis=1)) - weights
    _, logarithm = np.linalg.slogdet(laplacian[1:, 1:])
    return float(np.exp((np.log(n) + logarithm) / n))
