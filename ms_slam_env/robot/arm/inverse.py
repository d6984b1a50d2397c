"""Inverse kinematics of one pose from many starting points at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env.robot.arm.chain import Chain

Float64 = NDArray[np.float64]

_DAMPING = 1e-3  # of the pseudo-inverse, metres and radians
_LARGEST_STEP_RAD = 0.5


@dataclass(frozen=True)
class Solutions:
    """Joint angles (s, n) and how far the camera is from its target there, (s,) each."""

    q: Float64
    error_m: Float64
    error_rad: Float64

    def accurate(self, tolerance_m: float = 1e-6, tolerance_rad: float = 1e-6) -> NDArray[np.bool_]:
        """(s,) which of them put the camera on the target."""
        return (self.error_m < tolerance_m) & (self.error_rad < tolerance_rad)


def solve_pose(chain: Chain, q: Float64, T_base_camera: Float64, iterations: int = 30) -> Solutions:
    """Bring the camera to a pose (4, 4) by damped Newton steps from joint angles (s, n).

    Joint limits are not looked at. Wampler, "Manipulator inverse kinematic solutions based on
    vector formulations and damped least-squares methods" (1986), equation (10).
    """
    angles = np.array(q, dtype=np.float64)
    regularisation = _DAMPING**2 * np.eye(6)
    for _ in range(iterations):
        error = _twist(chain.camera_pose(angles), T_base_camera)
        if (np.abs(error) < 1e-10).all():
            break
        J = chain.camera_jacobian(angles)
        J_transposed = np.swapaxes(J, -1, -2)
        damped = np.linalg.solve(J @ J_transposed + regularisation, error[..., None])
        step = (J_transposed @ damped)[..., 0]
        largest = np.abs(step).max(axis=-1, keepdims=True)
        angles = angles + step * np.minimum(1.0, _LARGEST_STEP_RAD / np.maximum(largest, 1e-12))
    error = _twist(chain.camera_pose(angles), T_base_camera)
    return Solutions(
        angles, np.linalg.norm(error[..., :3], axis=-1), np.linalg.norm(error[..., 3:], axis=-1)
    )


def _twist(T_now: Float64, T_target: Float64) -> Float64:
    """(s, 6) translation and rotation vector, in the base frame, from (s, 4, 4) to the target."""
    turn = T_target[:3, :3] @ np.swapaxes(T_now[..., :3, :3], -1, -2)
    rotation = Rotation.from_matrix(turn).as_rotvec()
    return np.concatenate([T_target[:3, 3] - T_now[..., :3, 3], rotation], axis=-1)
