"""How far an arm's links are from where they may not go, and limits that keep them from it."""

from __future__ import annotations

import mink
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.robot.arm.chain import Chain, segment_distance
from ms_slam_env.robot.arm.surroundings import Surroundings

Float64 = NDArray[np.float64]

_SHORTEST_PART_M = 0.03  # of a capsule, between two balls that cover it
_NEAR_M = 0.05  # a gap beyond this is not limited
_STEP_RAD = 1e-5  # of the differences that stand for derivatives


class Clearance:
    """Gaps between what an arm's links need and what they have.

    Links are the chain's capsules, covered by balls. They need ``clearance_m`` to furniture and to
    each other; pairs that are closer than that at the arm's home need half that gap.
    """

    def __init__(self, chain: Chain, surroundings: Surroundings, clearance_m: float) -> None:
        self._chain = chain
        self._surroundings = surroundings
        moving = np.flatnonzero(chain.capsule_link > 0)
        ends, radius = chain.capsule_ends[moving], chain.capsule_radius[moving]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        parts = np.ceil(length / np.maximum(radius, _SHORTEST_PART_M) - 1e-6).astype(int)
        cover = np.hypot(radius, 0.5 * length / np.maximum(parts, 1)) + clearance_m
        self._capsule = np.repeat(moving, parts + 1)
        self._share = np.concatenate([np.arange(k + 1) / max(k, 1) for k in parts] or [[]])
        self._cover = np.repeat(cover, parts + 1)
        self._moving = moving
        self._far = 0.5 * length + radius + clearance_m
        pairs = chain.self_pairs
        self._pairs = pairs
        self._apart = chain.capsule_radius[pairs].sum(axis=1)
        self._apart += np.minimum(clearance_m, 0.5 * chain.self_gap)

    def gaps(self, q: Float64) -> Float64:
        """(k, g) metres to spare of every ball, then of every pair, at joint angles (k, n)."""
        ends = self._chain.capsules(q)
        return np.concatenate([self._furniture(ends), self._self(ends)], axis=-1)

    def least(self, q: Float64) -> Float64:
        """(k,) the least of the gaps at joint angles (k, n), or 0 where all are above it."""
        ends = self._chain.capsules(q)
        result = np.minimum(self._self(ends).min(axis=-1, initial=0.0), 0.0)
        middles = ends[..., self._moving, :, :].mean(axis=-2)
        spare = self._surroundings.distance(middles.reshape(-1, 3)).reshape(middles.shape[:-1])
        near = np.flatnonzero((spare < self._far).any(axis=-1))
        if len(near):
            balls = self._furniture(ends[near])
            beside = (spare[near] >= self._far)[:, np.searchsorted(self._moving, self._capsule)]
            worst = np.where(beside, 0.0, balls).min(axis=-1, initial=0.0)
            result[near] = np.minimum(result[near], worst)
        return np.asarray(result)

    def balls(self, q: Float64) -> Float64:
        """Centres (k, b, 3) of the balls in the base frame at joint angles (k, n)."""
        return self._balls(self._chain.capsules(q))

    @property
    def ball_radius(self) -> Float64:
        """(b,) radius of the capsule that each ball covers."""
        return np.asarray(self._chain.capsule_radius[self._capsule])

    def _balls(self, ends: Float64) -> Float64:
        start, stop = ends[..., self._capsule, 0, :], ends[..., self._capsule, 1, :]
        return np.asarray(start + self._share[:, None] * (stop - start))

    def _furniture(self, ends: Float64) -> Float64:
        centres = self._balls(ends)
        distance = self._surroundings.distance(centres.reshape(-1, 3))
        return np.asarray(distance.reshape(centres.shape[:-1]) - self._cover)

    def _self(self, ends: Float64) -> Float64:
        first, second = ends[..., self._pairs[:, 0], :, :], ends[..., self._pairs[:, 1], :, :]
        return np.asarray(segment_distance(first, second) - self._apart)


class ClearanceLimit(mink.Limit):
    """Lets a gap shrink by at most a share of itself per step: gradient . dq <= gain gap.

    A gap that is used up already may not shrink at all.

    Attributes:
        allowance_m: how much more than the gaps the links may use.
    """

    def __init__(
        self, clearance: Clearance, qpos: NDArray[np.int32], dof: NDArray[np.int32], gain: float
    ) -> None:
        self._clearance = clearance
        self._qpos, self._dof = qpos, dof
        self._gain = gain
        self.allowance_m = 0.0

    def compute_qp_inequalities(
        self, configuration: mink.Configuration, dt: float
    ) -> mink.Constraint:
        """Rows of the gaps below 5 cm; see mink's base class."""
        q = configuration.data.qpos[self._qpos]
        gaps = self._clearance.gaps(np.vstack([q, q + _STEP_RAD * np.eye(len(q))]))
        spare = gaps[0] + self.allowance_m
        near = spare < _NEAR_M
        if not near.any():
            return mink.Constraint()
        G = np.zeros((int(near.sum()), configuration.nv))
        G[:, self._dof] = -(gaps[1:, near] - gaps[0, near]).T / _STEP_RAD
        return mink.Constraint(G, self._gain * np.maximum(spare[near], 0.0))
