"""Inverse kinematics of single poses by damped Newton steps, and the seeds they start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.chain import Chain
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.feasibility import Feasibility

_DAMPING = 1e-3  # of the pseudo-inverse, metres and radians
_LARGEST_STEP_RAD = 0.5

LIMIT_MARGIN_RAD = 0.15
"""Distance that a posture keeps from joint limits, so that it can move both ways."""

STEP_M, STEP_RAD = 0.12, np.radians(12)
"""Size of the motions by which a posture is rated."""

PITCHES = np.linspace(-np.pi / 2, np.pi / 2, 19)
"""Pitches of the camera, from straight down to straight up, for which postures are kept."""

_SAMPLES = 20_000
_TRIED = 300
_KEPT = 24
_APART_M = 0.06  # least distance between the bases of two postures of one pitch
_EFFORT_DAMPING = 0.02
_TOO_HARD = 4.0
_AT_ONCE = 256


@dataclass(frozen=True)
class Solutions:
    """Joint angles (s, n), and the camera's distance and angle from its target, (s,) each."""

    q: Float64
    error_m: Float64
    error_rad: Float64

    def accurate(self, tolerance_m: float = 1e-6, tolerance_rad: float = 1e-6) -> NDArray[np.bool_]:
        """(s,) which solutions put the camera on the target."""
        return (self.error_m < tolerance_m) & (self.error_rad < tolerance_rad)


def solve_pose(chain: Chain, q: Float64, T_base_camera: Float64, iterations: int = 30) -> Solutions:
    """Bring the camera to a pose (4, 4) from joint angles (s, n), ignoring joint limits."""

    def task(angles: Float64) -> tuple[Float64, Float64]:
        return _twist(chain.camera_pose(angles), T_base_camera), chain.camera_jacobian(angles)

    def shorten(step: Float64) -> Float64:
        largest = np.abs(step).max(axis=-1, keepdims=True)
        return step * np.minimum(1.0, _LARGEST_STEP_RAD / np.maximum(largest, 1e-12))

    angles, error = _damped_newton(task, q, iterations, 1e-10, shorten)
    return Solutions(
        angles, np.linalg.norm(error[..., :3], axis=-1), np.linalg.norm(error[..., 3:], axis=-1)
    )


def _damped_newton(
    task: Callable[[Float64], tuple[Float64, Float64]],
    q: Float64,
    iterations: int,
    tolerance: float,
    shorten: Callable[[Float64], Float64],
) -> tuple[Float64, Float64]:
    """Joint angles (s, n) after damped Newton steps, and the remaining error.

    Wampler, "Manipulator inverse kinematic solutions based on vector formulations and damped
    least-squares methods" (1986), equation (10).

    Args:
        task: returns the error (s, e) of joint angles (s, n), and its Jacobian (s, e, n).
        q: (s, n) joint angles to start from.
        iterations: most steps.
        tolerance: largest error component at which iteration stops.
        shorten: shortens steps (s, n) to what linearisation allows.
    """
    angles = np.array(q, dtype=np.float64)
    for _ in range(iterations):
        error, J = task(angles)
        if (np.abs(error) < tolerance).all():
            break
        J_transposed = np.swapaxes(J, -1, -2)
        regularised = J @ J_transposed + _DAMPING**2 * np.eye(J.shape[-2])
        damped = np.linalg.solve(regularised, error[..., None])
        angles = angles + shorten((J_transposed @ damped)[..., 0])
    return angles, task(angles)[0]


def _twist(T_now: Float64, T_target: Float64) -> Float64:
    """(s, 6) translation and rotation vector, in the base frame, from (s, 4, 4) to the target."""
    turn = T_target[:3, :3] @ np.swapaxes(T_now[..., :3, :3], -1, -2)
    rotation = Rotation.from_matrix(turn).as_rotvec()
    return np.concatenate([T_target[:3, 3] - T_now[..., :3, 3], rotation], axis=-1)


@dataclass(frozen=True)
class IKSeeds:
    """Good postures of an arm for one pitch of the camera, the best first.

    Attributes:
        q: (l, n) joint angles; the camera has that pitch and no roll, the base is upright.
        motions: (l,) number of the 49 motions that are possible there in an empty world.
    """

    q: Float64
    motions: NDArray[np.int64]


@dataclass(frozen=True)
class Samples:
    """Joint angles (s, n) from an arm's whole range, with their camera poses and efforts.

    Attributes:
        q: (s, n).
        T_base_camera: (s, 4, 4).
        effort: (s,) see :func:`effort`.
    """

    q: Float64
    T_base_camera: Float64
    effort: Float64


class _Nothing:
    """A world without furniture."""

    def clearance(self, points: Float64) -> Float64:
        """Far (N,) from everything at points (N, 3)."""
        return np.full(len(points), 100.0)


@lru_cache(maxsize=8)
def sample_joints(chain: Chain, home: tuple[float, ...], config: ArmConfig) -> Samples:
    """Draw joint angles evenly, at most one turn around the home, from a fixed seed."""
    around = np.array(home)
    low = np.maximum(chain.lower + LIMIT_MARGIN_RAD, around - np.pi)
    high = np.minimum(chain.upper - LIMIT_MARGIN_RAD, around + np.pi)
    rng = np.random.default_rng(0)
    q = rng.uniform(np.minimum(low, high), np.maximum(low, high), (_SAMPLES, chain.num_joints))
    return Samples(q, chain.camera_pose(q), effort(chain, q, config.speed_m_s, config.speed_rad_s))


@lru_cache(maxsize=256)
def ik_seeds_at(
    chain: Chain, home: tuple[float, ...], config: ArmConfig, pitch_index: int
) -> IKSeeds:
    """Search for postures with the camera at one of ``PITCHES``, without roll.

    Random joint angles are adjusted until the camera has that pitch and no roll. Of those within
    joint limits and with links apart, the ones with the least effort and different base positions
    relative to the camera are kept, and their possible motions counted.
    """
    samples = sample_joints(chain, home, config)
    pitch = PITCHES[pitch_index]
    up = np.array([0.0, -np.cos(pitch), np.sin(pitch)])
    away = np.arccos(np.clip(samples.T_base_camera[:, 2, :3] @ up, -1, 1))
    start = np.argsort(samples.effort + 2 * away, kind="stable")[:_TRIED]
    q, reached = turn_upright(chain, samples.q[start], up)
    q = q[reached & chain.within_limits(q, LIMIT_MARGIN_RAD)]
    q = q[links_apart(chain, q)]
    q = q[np.argsort(effort(chain, q, config.speed_m_s, config.speed_rad_s), kind="stable")]
    q = _spread(chain, q)
    nowhere = ClearanceField(_Nothing(), np.eye(4), 0.5)
    feasibility = Feasibility(chain, nowhere, config)
    count = np.array([_count_motions(chain, feasibility, posture) for posture in q], dtype=np.int64)
    best = np.argsort(-count, kind="stable")
    return IKSeeds(q[best], count[best])


def _count_motions(chain: Chain, feasibility: Feasibility, q: Float64) -> int:
    return int(feasibility.probe(q, chain.camera_pose(q) @ decompose(STEP_M, STEP_RAD)).ok.sum())


def effort(chain: Chain, q: Float64, speed_m_s: float, speed_rad_s: float) -> Float64:
    """(s,) effort of the joints at (s, n), averaged over the 49 motions of the camera.

    The effort of a motion is the greatest ratio of needed to permitted joint speed, from the damped
    inverse of the Jacobian where the motion begins, clipped to at least 1 (the joints are fast
    enough) and at most 4 (too slow, or out of control).
    """
    rates = _camera_rates(speed_m_s, speed_rad_s)
    # small batches stay in the processor's cache
    some = [_effort(chain, q[i : i + _AT_ONCE], rates) for i in range(0, len(q), _AT_ONCE)]
    return np.concatenate([np.zeros(0), *some])


def _effort(chain: Chain, q: Float64, rates: Float64) -> Float64:
    """:func:`effort` (s,) by the motions' velocities (6, 49) in the camera's frame."""
    J = chain.camera_jacobian(q)
    R = chain.camera_pose(q)[:, :3, :3]
    twists = np.concatenate([R @ rates[:3], R @ rates[3:]], axis=1)  # (s, 6, 49)
    J_transposed = np.swapaxes(J, -1, -2)
    inverse = J_transposed @ np.linalg.inv(J @ J_transposed + _EFFORT_DAMPING**2 * np.eye(6))
    speeds = inverse @ twists
    ratio = np.abs(speeds / chain.speed[:, None]).max(axis=1)  # (s, 49)
    missed = np.linalg.norm(J @ speeds - twists, axis=1)
    ratio[missed > 0.3 * np.linalg.norm(twists, axis=1)] = np.inf
    return np.clip(ratio, 1.0, _TOO_HARD).mean(axis=1)


def _camera_rates(speed_m_s: float, speed_rad_s: float) -> Float64:
    """(6, 49) greatest linear and angular velocity of each motion in the camera's frame."""
    motions = decompose(STEP_M, STEP_RAD)
    step = np.concatenate(
        [motions[:, :3, 3], Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()], 1
    )
    least_s = np.maximum(
        np.linalg.norm(step[:, :3], axis=1) / speed_m_s,
        np.linalg.norm(step[:, 3:], axis=1) / speed_rad_s,
    )
    return (step / np.maximum(least_s, 1e-9)[:, None]).T


def turn_upright(
    chain: Chain, q: Float64, up: Float64, iterations: int = 12
) -> tuple[Float64, NDArray[np.bool_]]:
    """Turn joints (s, n) until the base's z axis is ``up`` (3,) in the camera's frame.

    Returns:
        Joint angles (s, n), and (s,) whether they are upright to 1e-9.
    """
    angles, error = _damped_newton(
        lambda angles: _uprightness(chain, angles, up),
        q,
        iterations,
        1e-12,
        lambda step: np.clip(step, -0.6, 0.6),
    )
    return angles, np.linalg.norm(error, axis=-1) < 1e-9


def _uprightness(chain: Chain, q: Float64, up: Float64) -> tuple[Float64, Float64]:
    """Error (s, 3) of the wanted up axis in the base frame, and its Jacobian (s, 3, n).

    The camera's wanted up axis ``R_base_camera up`` must be (0, 0, 1); a joint that turns with
    axis w moves it by w x it.
    """
    R = chain.camera_pose(q)[:, :3, :3]
    axis = R @ up
    turning = chain.camera_jacobian(q)[:, 3:]
    moved = np.cross(np.swapaxes(turning, -1, -2), axis[:, None, :])
    return np.array([0.0, 0.0, 1.0]) - axis, np.swapaxes(moved, -1, -2)


def links_apart(chain: Chain, q: Float64) -> NDArray[np.bool_]:
    """(s,) whether the pairs of links keep half the distance they have at home, at most 2 cm."""
    gap = chain.pair_gaps(q, chain.self_pairs)
    return np.asarray((gap >= np.minimum(0.02, 0.5 * chain.self_gap)).all(axis=-1))


def wrap_joints(chain: Chain, q: Float64) -> Float64:
    """Shift joint angles (s, n) by whole turns towards the middle of their limits."""
    limited = np.isfinite(chain.lower) & np.isfinite(chain.upper)
    low, high = np.where(limited, chain.lower, 0.0), np.where(limited, chain.upper, 0.0)
    middle = 0.5 * (low + high)
    return middle + np.remainder(q - middle + np.pi, 2 * np.pi) - np.pi


def _spread(chain: Chain, q: Float64) -> Float64:
    """Up to ``_KEPT`` of postures (s, n) with bases apart, preferring the first."""
    R_t = chain.camera_pose(q)
    base = -np.einsum("sji,sj->si", R_t[:, :3, :3], R_t[:, :3, 3])
    free = np.ones(len(q), dtype=bool)
    chosen: list[int] = []
    for index in range(len(q)):
        if len(chosen) == _KEPT:
            break
        if free[index]:
            chosen.append(index)
            free &= np.linalg.norm(base - base[index], axis=1) >= _APART_M
    return q[chosen]
