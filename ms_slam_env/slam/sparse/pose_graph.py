"""Pose graph through GTSAM: poses that agree best with measured motions between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.sparse.gtsam_library import load_gtsam
from ms_slam_env.slam.sparse.pose import orthonormal

_FIXED_SIGMA = 1e-6
_ITERATIONS = 20


@dataclass(frozen=True)
class Edge:
    """The measured motion between two poses.

    Attributes:
        a: index of the one,
        b: index of the other.
        T_a_b: (4, 4) motion.
        sigma_rad: standard deviation of its rotation,
        sigma_m: and translation.
    """

    a: int
    b: int
    T_a_b: Float64
    sigma_rad: float = 0.005
    sigma_m: float = 0.01


def optimise_poses(poses: Float64, edges: Sequence[Edge], fixed: NDArray[np.bool_]) -> Float64:
    """Poses (K, 4, 4) of least squares; those that are ``fixed`` (K,) stay.

    Raises:
        InputError: GTSAM is not installed.
    """
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
