"""Postures in which an arm moves its camera well: where the search for a place begins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env.robot.arm.chain import Chain, segment_distance
from ms_slam_env.robot.arm.model import ArmModel
from ms_slam_env.robot.motions import decompose

Float64 = NDArray[np.float64]

LIMIT_MARGIN_RAD = 0.15
"""Distance that a posture keeps from joint limits, so that motions are left on both sides."""

STEP_M, STEP_RAD = 0.12, np.radians(12)
"""Motions that a posture is judged by."""

_SAMPLES = 20_000
_PITCHES = 19  # evenly from straight down to straight up
_TRIED_PER_PITCH = 300
_KEPT_PER_PITCH = 24
_APART_M = 0.06  # least distance between the bases of two postures of one pitch
_DAMPING = 0.02
_TOO_HARD = 4.0


@dataclass(frozen=True)
class Postures:
    """Good postures of an arm, and many more that are merely possible.

    Attributes:
        q: (l, n) joint angles, best first within each pitch of the camera.
        up: (l, 3) the base's z axis in the camera's frame.
        effort: (l,) see :func:`effort`.
        any_q: (s, n) joint angles all over the arm's range.
        any_T_base_camera: (s, 4, 4) camera at those.
    """

    q: Float64
    up: Float64
    effort: Float64
    any_q: Float64
    any_T_base_camera: Float64


@lru_cache(maxsize=8)
def good_postures(model: ArmModel, speed_m_s: float, speed_rad_s: float) -> Postures:
    """Search an arm's joint space, from a fixed seed, for postures with the camera upright.

    For each of 19 pitches of the camera, random joint angles are turned until the camera has that
    pitch and no roll; kept are those of least effort that leave the links apart, with bases at
    different places as seen from the camera.
    """
    chain = model.chain
    low, high = _range(chain, model.home)
    rng = np.random.default_rng(0)
    any_q = rng.uniform(low, high, (_SAMPLES, chain.num_joints))
    any_camera = chain.camera_pose(any_q)
    any_effort = effort(chain, any_q, speed_m_s, speed_rad_s)
    any_up = any_camera[:, 2, :3]
    kept = []
    for pitch in np.linspace(-np.pi / 2, np.pi / 2, _PITCHES):
        up = np.array([0.0, -np.cos(pitch), np.sin(pitch)])
        score = any_effort + 2 * np.arccos(np.clip(any_up @ up, -1, 1))
        start = np.argsort(score, kind="stable")[:_TRIED_PER_PITCH]
        q, reached = turn_upright(chain, any_q[start], up)
        q = q[reached & chain.within_limits(q, LIMIT_MARGIN_RAD)]
        q = q[links_apart(chain, q)]
        q = q[np.argsort(effort(chain, q, speed_m_s, speed_rad_s), kind="stable")]
        kept.append(_spread(chain, q))
    q = np.concatenate(kept)
    return Postures(
        q=q,
        up=chain.camera_pose(q)[:, 2, :3],
        effort=effort(chain, q, speed_m_s, speed_rad_s),
        any_q=any_q,
        any_T_base_camera=any_camera,
    )


def effort(chain: Chain, q: Float64, speed_m_s: float, speed_rad_s: float) -> Float64:
    """(s,) how hard the joints at (s, n) work, on average over the 49 motions of the camera.

    For each motion the greatest ratio of needed to permitted joint speed, by the damped inverse of
    the Jacobian where the motion begins, at least 1 (the joints are fast enough) and at most 4
    (too slow, or out of control).
    """
    if len(q) == 0:
        return np.zeros(0)
    J = chain.camera_jacobian(q)
    R = chain.camera_pose(q)[:, :3, :3]
    rates = _camera_rates(speed_m_s, speed_rad_s)
    twists = np.concatenate([R @ rates[:3], R @ rates[3:]], axis=1)  # (s, 6, 49)
    J_transposed = np.swapaxes(J, -1, -2)
    inverse = J_transposed @ np.linalg.inv(J @ J_transposed + _DAMPING**2 * np.eye(6))
    speeds = inverse @ twists
    ratio = np.abs(speeds / chain.speed[:, None]).max(axis=1)  # (s, 49)
    missed = np.linalg.norm(J @ speeds - twists, axis=1)
    ratio[missed > 0.3 * np.linalg.norm(twists, axis=1)] = np.inf
    return np.clip(ratio, 1.0, _TOO_HARD).mean(axis=1)


def _camera_rates(speed_m_s: float, speed_rad_s: float) -> Float64:
    """(6, 49) greatest linear and angular velocity of each motion in the camera's frame."""
    motions = decompose(STEP_M, STEP_RAD)
    way = np.concatenate(
        [motions[:, :3, 3], Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()], 1
    )
    least_s = np.maximum(
        np.linalg.norm(way[:, :3], axis=1) / speed_m_s,
        np.linalg.norm(way[:, 3:], axis=1) / speed_rad_s,
    )
    return (way / np.maximum(least_s, 1e-9)[:, None]).T


def turn_upright(
    chain: Chain, q: Float64, up: Float64, iterations: int = 12
) -> tuple[Float64, NDArray[np.bool_]]:
    """Turn joints (s, n) until the base's z axis is ``up`` (3,) in the camera's frame.

    Returns:
        Joint angles (s, n), and (s,) whether they do it to 1e-9.
    """
    angles = np.array(q, dtype=np.float64)
    for _ in range(iterations):
        error, J = _uprightness(chain, angles, up)
        if (np.abs(error) < 1e-12).all():
            break
        J_transposed = np.swapaxes(J, -1, -2)
        damped = np.linalg.solve(J @ J_transposed + 1e-6 * np.eye(3), error[..., None])
        angles = angles + np.clip((J_transposed @ damped)[..., 0], -0.6, 0.6)
    error, _ = _uprightness(chain, angles, up)
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
    ends = chain.capsules(q)
    first, second = chain.self_pairs[:, 0], chain.self_pairs[:, 1]
    gap = segment_distance(ends[:, first], ends[:, second])
    gap = gap - chain.capsule_radius[first] - chain.capsule_radius[second]
    return np.asarray((gap >= np.minimum(0.02, 0.5 * chain.self_gap)).all(axis=-1))


def wrap_joints(chain: Chain, q: Float64) -> Float64:
    """Joint angles (s, n) moved by whole turns towards the middle of their limits."""
    middle = np.where(np.isfinite(chain.lower), 0.5 * (chain.lower + chain.upper), 0.0)
    return middle + np.remainder(q - middle + np.pi, 2 * np.pi) - np.pi


def _range(chain: Chain, home: Float64) -> tuple[Float64, Float64]:
    """Bounds (n,) of joint angles to search: the limits, at most one turn around the home."""
    low = np.maximum(chain.lower + LIMIT_MARGIN_RAD, home - np.pi)
    high = np.minimum(chain.upper - LIMIT_MARGIN_RAD, home + np.pi)
    return np.minimum(low, high), np.maximum(low, high)


def _spread(chain: Chain, q: Float64) -> Float64:
    """Up to ``_KEPT_PER_PITCH`` of postures (s, n), the first preferred, with bases apart."""
    R_t = chain.camera_pose(q)
    base = -np.einsum("sji,sj->si", R_t[:, :3, :3], R_t[:, :3, 3])
    free = np.ones(len(q), dtype=bool)
    chosen: list[int] = []
    for index in range(len(q)):
        if len(chosen) == _KEPT_PER_PITCH:
            break
        if free[index]:
            chosen.append(index)
            free &= np.linalg.norm(base - base[index], axis=1) >= _APART_M
    return q[chosen]
