"""Exponential and logarithm of SO(3) and SE(3), in float64.

Source: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018),
equations (132) to (146) and (172) to (174). A twist is (rho, phi): translation part first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64

_SMALL_ANGLE = 1e-5  # below this the closed forms lose digits to cancellation; use their series


def hat(phi: ArrayLike) -> Float64:
    """Skew matrices (..., 3, 3) with ``hat(phi) @ v == cross(phi, v)``, of ``phi`` (..., 3)."""
    vector = np.asarray(phi, dtype=np.float64)
    skew = np.zeros((*vector.shape, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        skew[..., row, column] = vector[..., axis]
        skew[..., column, row] = -vector[..., axis]
    return skew


def so3_exp(phi: ArrayLike) -> Float64:
    """Rotation matrix (3, 3) of the rotation vector ``phi`` (3,) in radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.asarray(phi, dtype=np.float64)).as_matrix()


def so3_log(R: ArrayLike) -> Float64:
    """Rotation vectors (..., 3) in radians, of angle at most pi, of matrices ``R`` (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(np.asarray(R, dtype=np.float64)).as_rotvec()


def _left_jacobian(phi: Float64) -> Float64:
    """V(phi) (3, 3), equation (174): the translation of exp(rho, phi) is V(phi) @ rho."""
    angle = float(np.linalg.norm(phi))
    skew = hat(phi)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + skew / 2 + skew @ skew / 6
    a = (1 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + a * skew + b * skew @ skew


def se3_exp(twist: ArrayLike) -> Float64:
    """Rigid motion (4, 4) of the twist (6,) = (rho in metres, phi in radians), equation (172)."""
    xi = np.asarray(twist, dtype=np.float64)
    T = np.eye(4)
    T[:3, :3] = so3_exp(xi[3:])
    T[:3, 3] = _left_jacobian(xi[3:]) @ xi[:3]
    return T


def se3_log(T: ArrayLike) -> Float64:
    """Twist (6,) = (rho in metres, phi in radians) of the rigid motion ``T`` (4, 4), eq. (173)."""
    matrix = np.asarray(T, dtype=np.float64)
    phi = so3_log(matrix[:3, :3])
    rho = np.linalg.solve(_left_jacobian(phi), matrix[:3, 3])
    return np.concatenate([rho, phi])


def adjoint(T: ArrayLike) -> Float64:
    """Matrices (..., 6, 6) that map twists from frame b to frame a; equation (175).

    ``T`` (..., 4, 4) is T_a_b.
    """
    matrix = np.asarray(T, dtype=np.float64)
    R = matrix[..., :3, :3]
    mapping = np.zeros((*matrix.shape[:-2], 6, 6))
    mapping[..., :3, :3] = mapping[..., 3:, 3:] = R
    mapping[..., :3, 3:] = hat(matrix[..., :3, 3]) @ R
    return mapping
