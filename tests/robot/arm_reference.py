"""A slow, obvious version of what ``Feasibility`` decides, for tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.cartesian_path import progress
from ms_slam_env.robot.arm.chain import Chain, segment_distance
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.feasibility import DAMPING, LIMIT_MARGIN_RAD, MOST_STRETCH


class Balls:
    """Balls in empty space."""

    def __init__(self, *balls):
        self.balls = balls

    def clearance(self, points):
        distance = np.full(len(points), 9.0)
        for centre, radius in self.balls:
            distance = np.minimum(distance, np.linalg.norm(points - centre, axis=1) - radius)
        return np.maximum(distance, 0)


@dataclass(frozen=True)
class SlowWay:
    """Joint angles along a way, and by how much each requirement is kept (< 0: broken)."""

    q: np.ndarray  # (W, n)
    off_m: float
    off_rad: float
    stretch: float
    furniture_spare_m: float  # beyond the radius of the links
    self_spare_m: float  # beyond radii and what the pair needs

    def broken(self, slack: float) -> set[str]:
        """What is not kept; ``slack`` > 0 forgives, < 0 asks for more."""
        off = max(self.off_m / 1.8e-3, self.off_rad / np.radians(0.18))
        kept = {
            "way": off < 1 + 10 * slack,
            "joint speed": self.stretch < 1.15 * MOST_STRETCH * (1 + slack),
            "furniture": self.furniture_spare_m > -slack,
            "self-collision": self.self_spare_m > -slack,
        }
        return {name for name, value in kept.items() if not value}


def solve(
    chain: Chain, q: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Inverse kinematics between limits near ``q`` by SciPy, without our Newton steps."""
    still = np.sqrt(DAMPING) * np.eye(len(q))

    def error(angles: np.ndarray) -> np.ndarray:
        T = chain.camera_pose(angles)
        turn = Rotation.from_matrix(target[:3, :3] @ T[:3, :3].T).as_rotvec()
        return np.concatenate([target[:3, 3] - T[:3, 3], turn, still @ (angles - q)])

    def slope(angles: np.ndarray) -> np.ndarray:
        return np.concatenate([-chain.camera_jacobian(angles), still])

    inside = np.clip(q, low + 1e-9, high - 1e-9)
    found = least_squares(error, inside, slope, (low, high), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return found.x, np.linalg.norm(found.fun[:3]), np.linalg.norm(found.fun[3:6])


def follow(
    chain: Chain,
    clearance_field: ClearanceField,
    config: ArmConfig,
    q: np.ndarray,
    target: np.ndarray,
    waypoints: int,
) -> SlowWay:
    """Follow the straight way to a camera pose (4, 4) with ``waypoints`` joint configurations."""
    start = chain.camera_pose(q)
    share = progress(np.linspace(0, 1, waypoints))
    turning = Slerp([0, 1], Rotation.from_matrix([start[:3, :3], target[:3, :3]]))
    angle = (turning(0.0).inv() * turning(1.0)).magnitude()
    distance = np.linalg.norm(target[:3, 3] - start[:3, 3])
    duration = 1.25 * max(distance / config.speed_m_s, angle / config.speed_rad_s)
    low = np.minimum(chain.lower + LIMIT_MARGIN_RAD, q)
    high = np.maximum(chain.upper - LIMIT_MARGIN_RAD, q)
    ways, off_m, off_rad = [q], 0.0, 0.0
    for s in share[1:]:
        T = np.eye(4)
        T[:3, :3] = turning(s).as_matrix()
        T[:3, 3] = (1 - s) * start[:3, 3] + s * target[:3, 3]
        angles, metres, radians = solve(chain, ways[-1], T, low, high)
        ways.append(angles)
        off_m, off_rad = max(off_m, metres), max(off_rad, radians)
    joints = np.stack(ways)
    speed = np.abs(np.diff(joints, axis=0)) * (waypoints - 1) / duration
    furniture, apart = spares(chain, clearance_field, joints[1:], config.clearance_m)
    return SlowWay(
        joints,
        off_m,
        off_rad,
        float((speed / chain.speed).max()),
        furniture - config.clearance_m,
        apart,
    )


def spares(
    chain: Chain, clearance_field: ClearanceField, joints: np.ndarray, clearance_m: float
) -> tuple[float, float]:
    """Least distance of links to furniture, and of pairs of links beyond what they need."""
    furniture, apart = np.inf, np.inf
    moving = np.flatnonzero(chain.capsule_link > 0)
    need = np.minimum(clearance_m, 0.5 * chain.self_gap)
    for q in joints:
        ends = chain.capsules(q)
        for i in moving:
            points = ends[i, 0] + np.linspace(0, 1, 40)[:, None] * (ends[i, 1] - ends[i, 0])
            free = clearance_field.distance(points).min() - chain.capsule_radius[i]
            furniture = min(furniture, free)
        first, second = chain.self_pairs.T
        gap = segment_distance(ends[first], ends[second])
        gap = gap - chain.capsule_radius[first] - chain.capsule_radius[second] - need
        apart = min(apart, gap.min(initial=np.inf))
    return float(furniture), float(apart)
