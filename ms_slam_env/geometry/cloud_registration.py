"""Point cloud registration by iterative closest points, mostly with small_gicp.

Used as in Qu, Zhang, Yang, Dong, "USME", Navigation Positioning and Timing 2021, section 1.2:
clouds are registered, equation (6), before their distance is measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import se3_exp, transform_points
from ms_slam_env.geometry.point_clouds import IndexedCloud, check_points, indexed

REGISTRATIONS = ("none", "icp", "plane-icp", "gicp")
CUTOFF_M = 0.5
NEIGHBOURS = 20  # used to estimate a point's normal
_ITERATIONS = 100
_STEP = 1e-6  # metres and radians; a smaller step ends the search


@dataclass(frozen=True)
class CloudRegistration:
    """Result of a registration.

    Attributes:
        T_target_source: (4, 4) rigid motion onto the target; the identity if nothing is near.
        converged: whether the search converged.
        iterations: number of iterations.
        pairs: number of points with a partner within the cut-off at the end.
        share: their share of the points that were matched.
    """

    T_target_source: Float64
    converged: bool
    iterations: int
    pairs: int
    share: float


def register_clouds(
    source: ArrayLike,
    target: ArrayLike | IndexedCloud,
    method: str = "icp",
    cutoff_m: float = CUTOFF_M,
    max_points: int = 20_000,
    neighbours: int = NEIGHBOURS,
) -> CloudRegistration:
    """Find the rigid motion of ``source`` (N, 3) onto ``target`` (M, 3), in metres.

    It starts from the identity, so the clouds must nearly coincide, as an estimated and a true map
    do.

    Args:
        source: the cloud to move.
        target: the cloud that stays.
        method: ``icp`` minimises the sum of |T a - b|^2 over nearest points (Besl and McKay, PAMI
            1992), ``plane-icp`` that of (n_b . (T a - b))^2 (Chen and Medioni, IVC 1992). ``gicp``
            weights T a - b by the surface shape at both points (Segal et al., "Generalized-ICP",
            RSS 2009). ``none`` does not move the source.
        cutoff_m: pairs farther apart are left out.
        max_points: most source points to match, picked evenly.
        neighbours: number of neighbours used to estimate a point's normal.

    Raises:
        InputError: invalid points, an unknown method, a cut-off that is not positive, too few
            points for ``neighbours``.
    """
    cloud, fixed = check_points(source, "source"), indexed(target, "target")
    if method not in REGISTRATIONS:
        raise unknown("registration", method, REGISTRATIONS)
    if not (np.isfinite(cutoff_m) and cutoff_m > 0):
        raise InputError(f"cutoff_m must be finite and > 0, got {cutoff_m}")
    if method == "none":
        return CloudRegistration(np.eye(4), True, 0, len(cloud), 1.0)
    picked = cloud[np.unique(np.linspace(0, len(cloud) - 1, max_points).astype(int))]
    if method != "icp" and min(len(picked), len(fixed)) < neighbours:
        raise InputError(f"{method} needs at least {neighbours} points in either cloud")
    if method == "plane-icp":
        return _plane_icp(picked, fixed.points, cutoff_m, neighbours)
    return _small_gicp(picked, fixed, method, cutoff_m, neighbours)


def _small_gicp(
    source: Float64, target: IndexedCloud, method: str, cutoff_m: float, neighbours: int
) -> CloudRegistration:
    import small_gicp

    moving, fixed = IndexedCloud(source).gicp, target.gicp
    if method == "gicp":
        for cloud, tree in (moving, fixed):
            small_gicp.estimate_covariances(cloud, tree, neighbours, 1)
    found = small_gicp.align(
        target=fixed[0],
        source=moving[0],
        target_tree=fixed[1],
        registration_type=method.upper(),
        max_correspondence_distance=cutoff_m,
        num_threads=1,  # more threads would not sum in a fixed order
        max_iterations=_ITERATIONS,
        rotation_epsilon=_STEP,
        translation_epsilon=_STEP,
    )
    T, pairs = np.array(found.T_target_source), int(found.num_inliers)
    if pairs < 3 or not np.isfinite(T).all():
        return CloudRegistration(np.eye(4), False, int(found.iterations), 0, 0.0)
    return CloudRegistration(
        T, bool(found.converged), int(found.iterations), pairs, pairs / len(source)
    )


def _plane_icp(
    source: Float64, target: Float64, cutoff_m: float, neighbours: int
) -> CloudRegistration:
    """Point-to-plane ICP by Gauss-Newton on the distances along the normals.

    small_gicp's own PLANE_ICP ends millimetres from the least sum of (n_b . (T a - b))^2 on slanted
    surfaces; this and Open3D's reach it.
    """
    import small_gicp
    from scipy.spatial import cKDTree

    cloud = small_gicp.PointCloud(target)
    small_gicp.estimate_normals(cloud, small_gicp.KdTree(cloud), neighbours, 1)
    normals = cloud.normals()[:, :3]
    tree = cKDTree(target)
    T, count = np.eye(4), 0
    for iteration in range(1, _ITERATIONS + 1):
        moved = transform_points(T, source)
        distance, index = tree.query(moved, distance_upper_bound=cutoff_m)
        near = np.isfinite(distance)
        count = int(near.sum())
        if count < 6:
            return CloudRegistration(np.eye(4), False, iteration, 0, 0.0)
        a, b, n = moved[near], target[index[near]], normals[index[near]]
        J = np.concatenate([n, np.cross(a, n)], axis=1)  # of n . (a + rho + phi x a - b)
        step = np.linalg.lstsq(J, -np.einsum("ij,ij->i", n, a - b), rcond=None)[0]
        T = se3_exp(step) @ T
        if np.abs(step).max() < _STEP:
            return CloudRegistration(T, True, iteration, count, count / len(source))
    return CloudRegistration(T, False, _ITERATIONS, count, count / len(source))
