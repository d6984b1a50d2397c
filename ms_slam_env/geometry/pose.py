"""Poses as (4, 4) float64 matrices; ``T_a_b`` maps points of frame b into frame a."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError

MAX_COORDINATE_M = 1e9
"""Positions farther from the origin are taken for errors; their squares lose all precision."""

_IDENTITY = np.eye(4)


def as_numbers(values: ArrayLike, name: str) -> Float64:
    """Convert ``values`` to a float64 array.

    Raises:
        InputError: not an array of numbers.
    """
    try:
        if not np.iscomplexobj(values):
            return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{name} is not an array of numbers") from None


def check_pose(T: ArrayLike, name: str = "pose") -> Float64:
    """Return ``T`` as float64 (4, 4) after checking that it is a rigid motion.

    Raises:
        InputError: not numbers, wrong shape, a value that is not finite, a position beyond
            `MAX_COORDINATE_M`, or a rotation part that is not orthonormal to 1e-4 with determinant
            +1.
    """
    try:
        matrix = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} must be a (4, 4) array of numbers, got {T!r}") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{name} must have shape (4, 4), got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InputError(f"{name} holds a value that is not finite")
    if not np.abs(matrix[:3, 3]).max() <= MAX_COORDINATE_M:
        raise InputError(f"{name} is farther than {MAX_COORDINATE_M:g} m from the origin")
    R = matrix[:3, :3]
    is_rigid = (  # written out because np.allclose costs more than everything else here
        (np.abs(R @ R.T - _IDENTITY[:3, :3]) < 1e-4).all()
        and (np.abs(matrix[3] - _IDENTITY[3]) < 1e-6).all()
        and np.linalg.det(R) > 0
    )
    if not is_rigid:
        raise InputError(f"{name} is not a rigid motion (rotation part not orthonormal)")
    return matrix


def make_pose(R: ArrayLike, t: ArrayLike) -> Float64:
    """Return the (4, 4) rigid motion [R | t] of a rotation (3, 3) and a translation (3,) in m."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def invert(T: ArrayLike) -> Float64:
    """Inverse of rigid motions (..., 4, 4) without a general matrix inversion."""
    matrix = np.asarray(T, dtype=np.float64)
    inverse = np.zeros_like(matrix)
    R_transposed = np.swapaxes(matrix[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = R_transposed
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", R_transposed, matrix[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def orthonormal(T: ArrayLike) -> Float64:
    """The rigid motion nearest to a matrix (4, 4) with accumulated rounding errors."""
    matrix = np.asarray(T, dtype=np.float64)
    U, _, Vt = np.linalg.svd(matrix[:3, :3])
    return make_pose(U @ Vt, matrix[:3, 3])


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Float64:
    """Map points (..., 3) from frame b to frame a by one motion (4, 4)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.asarray(points_b, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def relative_angle(R_a: ArrayLike, R_b: ArrayLike) -> float:
    """Angle in radians of the rotation between two rotation matrices (3, 3)."""
    from scipy.spatial.transform import Rotation

    difference = np.asarray(R_a, dtype=np.float64).T @ np.asarray(R_b, dtype=np.float64)
    return float(Rotation.from_matrix(difference).magnitude())


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Float64:
    """Camera pose T_world_camera (x right, y down, z forward) at ``eye`` looking at ``target``.

    Raises:
        InputError: if ``eye`` and ``target`` coincide.
    """
    origin = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - origin
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise InputError("look_at needs an eye and a target that differ")
    forward = forward / distance
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-6:  # looking along `up`: any perpendicular will do
        right = np.cross(forward, [0.0, 1.0, 0.0])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    return make_pose(np.stack([right, down, forward], axis=1), origin)


def pose_from_quaternion(t: ArrayLike, q_xyzw: ArrayLike) -> Float64:
    """Poses (..., 4, 4) of translations (..., 3) in m and quaternions (..., 4), qx qy qz qw."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_quat(np.asarray(q_xyzw, dtype=np.float64)).as_matrix()
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def quaternion_from_pose(T: ArrayLike) -> Float64:
    """Quaternions (..., 4), qx qy qz qw, of unit length with qw >= 0, of poses (..., 4, 4)."""
    from scipy.spatial.transform import Rotation

    R = np.asarray(T, dtype=np.float64)[..., :3, :3]
    return Rotation.from_matrix(R).as_quat(canonical=True)
