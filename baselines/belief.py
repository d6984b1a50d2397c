"""Belief-space planning: map surface in its true place, and keep the pose certain."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.view_goals import poses_between

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import adjoint, hat, invert
from ms_slam_env.planning import view_information
from ms_slam_env.planning.trackability import SCALE, mean_depth, risk_of
from ms_slam_env.planning.view_goals import distance_in_steps
from ms_slam_env.slam.slam_backend import Views

if TYPE_CHECKING:
    from ms_slam_env.env.robot_view import RobotView

CORRECT_M = 0.05
"""Largest error of surface that counts as correct."""
_COMPARED = 6  # goals whose paths are predicted
_STOPS = 2  # views predicted on a path
_DRIFT = np.diag([2e-3**2] * 3 + [2e-3**2] * 3)
"""Q: covariance added by one motion, m^2 and rad^2; the RPE of a step in `living_room`."""
_START = np.diag([1e-3**2] * 6)  # until SLAM gives a covariance


class Belief(NextBestView):
    """Goes where it expects to map most surface within 5 cm of its true place.

    The pose covariance is propagated along the path to a goal,

        Sigma <- Ad Sigma Ad^T + Q,    Sigma <- (Sigma^-1 + f H)^-1,

    for every motion and every view on the way. H is the information of the predicted view, and f
    is such that, for the present view, f H is the information that SLAM reports for its pose. The
    value of a goal is its gain (as in `nbv`) times the probability that a point in the middle of
    its view lands within 5 cm of its place: that SLAM does not slip on the way (see
    `trackability`), and that the Gaussian error is small enough. ``caution`` times the best gain is
    subtracted for every (5 cm)^2 by which det(Sigma)^(1/6) grows (Carrillo, Reid, Castellanos, ICRA
    2012, on D-optimality).

    Args:
        robot: the robot's view.
        seed: for drawing goals.
        caution: price of uncertainty, see above.
        **options: see `NextBestView`.

    Raises:
        InputError: an option out of its range.
    """

    def __init__(
        self, robot: RobotView, seed: int = 0, caution: float = 1.0, **options: Any
    ) -> None:
        super().__init__(robot, seed, **options)
        self.caution = caution
        self.check({"caution": (0, 1e6)})

    def choose_goal(self, here: Float64) -> Float64:
        """The goal pose (4, 4) with the best expected surface, path cost and uncertainty."""
        poses, worth = self.drawn_goals(here)
        best = np.argsort(-worth * self.is_new(poses, here))[:_COMPARED]
        ways = np.stack([poses_between(here, poses[n], _STOPS) for n in best])
        seen_from = np.concatenate([here[None], ways.reshape(-1, 4, 4)])
        views = self.robot.predict(seen_from, SCALE)
        correct, growth = self.along(ways, views, distance_in_steps(poses[best], here, *self.steps))
        value = worth[best] * correct - self.caution * worth[best[0]] * growth / CORRECT_M**2
        return poses[best[int(np.argmax(value))]]

    def along(self, ways: Float64, views: Views, distances: Float64) -> tuple[Float64, Float64]:
        """Predict the pose uncertainty at the end of K paths of S stops.

        Args:
            ways: (K, S, 4, 4) poses.
            views: 1 + K S, from the current pose and all stops.
            distances: (K, 2) steps of translation and of rotation that a path takes.

        Returns:
            The probability (K,) that surface seen from the end lands within 5 cm, and the growth of
            the covariance's D-optimality (K,).
        """
        covariance, count = self.robot.pose_covariance, ways.shape[1]
        start = _START if covariance is None else np.array(covariance)
        H, depth = view_information(views), mean_depth(views)
        information = in_metres_and_radians(H, depth)
        information *= trust(start, information[0])
        motions = distances.max(axis=1) / count  # from stop to stop
        turn = self.steps[1] * distances[:, 1] / np.maximum(distances.max(axis=1), 1)
        turn /= self.frames
        slips = risk_of(H, views, np.r_[0, np.repeat(turn, count)], depth)[1:].reshape(-1, count)
        holds = np.prod((1 - slips) ** (self.frames * motions[:, None]), axis=1)
        here = self.robot.T_world_camera_estimate
        ends = [
            propagated(start, [here, *way], of_way, between)
            for way, of_way, between in zip(
                ways, information[1:].reshape(-1, count, 6, 6), motions, strict=True
            )
        ]
        last = depth[1:].reshape(-1, count)[:, -1]
        near = [probability_within(end, z) for end, z in zip(ends, last, strict=True)]
        growth = [d_optimality(end) - d_optimality(start) for end in ends]
        return holds * np.array(near), np.array(growth)


def in_metres_and_radians(H: Float64, depth_m: Float64) -> Float64:
    """Convert information of views with mean depths (N,) to that (N, 6, 6) of twist (rho, phi)."""
    scale = np.ones((len(H), 6))
    scale[:, 3:] = depth_m[:, None]
    return np.asarray(H * scale[:, :, None] * scale[:, None, :])


def trust(covariance: Float64, information: Float64) -> float:
    """f: ratio of the information in SLAM's pose to the ``information`` (6, 6) of its view.

    Compares determinants, and so all directions at once.
    """
    return 1 / max(d_optimality(covariance) * d_optimality(information), 1e-9)


def propagated(covariance: Float64, way: list[Float64], H: Float64, motions: float) -> Float64:
    """Covariance (6, 6) at the end of a path.

    Args:
        covariance: at its start, of the twist (rho, phi) in the camera frame.
        way: poses (S + 1) from the start to the end.
        H: (S, 6, 6) information of the views after the start.
        motions: number of motions between two of the poses.
    """
    for before, after, information in zip(way, way[1:], H, strict=False):
        Ad = adjoint(invert(after) @ before)
        covariance = Ad @ covariance @ Ad.T + motions * _DRIFT
        covariance = np.linalg.inv(np.linalg.inv(covariance) + information)
    return covariance


def d_optimality(matrix: Float64) -> float:
    """det(M)^(1/6) of a symmetric positive matrix (6, 6); 0 where it is singular."""
    sign, logarithm = np.linalg.slogdet(matrix)
    return math.exp(logarithm / 6) if sign > 0 else 0.0


def probability_within(covariance: Float64, depth_m: float, radius_m: float = CORRECT_M) -> float:
    """Probability that a point on the optical axis at a depth lands within a radius of its place.

    Its error is Gaussian with covariance J Sigma J^T, J = [I | -p x]. The mean of the three
    variances is used in every direction, so that the error follows a chi distribution with three
    degrees of freedom.
    """
    J = np.hstack([np.eye(3), hat([0, 0, -depth_m])])
    sigma = math.sqrt(max(np.trace(J @ covariance @ J.T) / 3, 1e-18))
    x = radius_m / sigma
    return math.erf(x / math.sqrt(2)) - math.sqrt(2 / math.pi) * x * math.exp(-x * x / 2)
