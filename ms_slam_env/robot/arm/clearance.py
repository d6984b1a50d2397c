"""Clearance field around an arm, and the gaps that its links keep to furniture and each other."""

from __future__ import annotations

import mink
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.geometry import transform_points
from ms_slam_env.robot.arm.chain import Chain, segment_distance
from ms_slam_env.robot.embodiment import HasClearance
from ms_slam_env.scenes.free_space import trilinear
from ms_slam_env.scenes.mesh_scene import MeshScene

_VOXEL_M = 0.05
_SLACK = 0.5  # of a voxel


class ClearanceField:
    """Distances to the scene's surface in a cube around the arm's base.

    The grid is aligned with the world. For a scene that has a grid it is a part of that grid, which
    avoids the error of a second interpolation; other scenes are sampled.

    ``distance`` errs to the safe side: ``slack_m`` = half a voxel is subtracted. Measured against
    the surface of six scenes, a scene's grid is too large by more than 0.7 voxels at less than 1 %
    of points (below 30 cm; by 1.4 voxels at worst, where furniture bends within a voxel).

    Attributes:
        T_world_base: (4, 4) the arm's base.
        grid: (nx, ny, nz) float32 metres, slack subtracted, at least 0; 0 inside objects.
        origin: (3,) centre of the first voxel in the world.
        voxel_m: edge of a voxel.
        slack_m: metres subtracted from every distance.
    """

    def __init__(self, scene: HasClearance, T_world_base: Float64, reach_m: float) -> None:
        self.T_world_base = np.array(T_world_base, dtype=np.float64)
        centre = self.T_world_base[:3, 3]
        if isinstance(scene, MeshScene):
            self.voxel_m = scene.free_space.voxel_m
            self.origin, distance = _part(scene, centre, reach_m)
        else:
            self.voxel_m = _VOXEL_M
            self.origin, distance = _sampled(scene, centre, reach_m)
        self.slack_m = _SLACK * self.voxel_m
        self.grid: Float32 = np.maximum(distance - np.float32(self.slack_m), np.float32(0))

    def distance(self, points_base: Float64) -> Float64:
        """Distances (N,) of points (N, 3) in the base frame; 0 inside objects or off the grid."""
        world = transform_points(self.T_world_base, np.reshape(points_base, (-1, 3)))
        place = (world - self.origin) / self.voxel_m
        limit = np.array(self.grid.shape) - 1
        clipped = np.clip(place, 0.0, limit)
        base = np.minimum(clipped.astype(np.int64), limit - 1)
        x, y, z = (np.stack([base[:, k], base[:, k] + 1], axis=1) for k in range(3))
        values = self.grid[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
        result = trilinear(values.astype(np.float64), clipped - base)
        return np.where((place == clipped).all(axis=1), result, 0.0)


def _part(scene: MeshScene, centre: Float64, reach_m: float) -> tuple[Float64, Float32]:
    """Origin (3,) and values of the part of the scene's grid that is within reach.

    The border of the scene's grid is 0, so an empty part is one voxel of it.
    """
    free = scene.free_space
    low = np.floor((centre - reach_m - free.origin) / free.voxel_m).astype(int)
    high = np.ceil((centre + reach_m - free.origin) / free.voxel_m).astype(int) + 1
    last = np.array(free.distance.shape)
    low = np.clip(low, 0, last - 2)
    high = np.clip(high, low + 2, last)
    part = free.distance[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    return free.origin + low * free.voxel_m, part


def _sampled(scene: HasClearance, centre: Float64, reach_m: float) -> tuple[Float64, Float32]:
    """Origin (3,) and values of a grid over the cube within reach."""
    origin = centre - reach_m
    count = int(np.ceil(2 * reach_m / _VOXEL_M)) + 1
    ticks = np.arange(count) * _VOXEL_M
    points = np.stack(np.meshgrid(*(origin[k] + ticks for k in range(3)), indexing="ij"), axis=-1)
    values = scene.clearance(points.reshape(-1, 3)).reshape(count, count, count)
    return origin, values.astype(np.float32)


_NEAR_M = 0.05  # larger gaps are not limited
_STEP_RAD = 1e-5  # of finite differences


class LinkClearance:
    """Gaps: the distances that an arm's links have, less the clearance that they need.

    Links are the chain's capsules, covered by balls. They need ``clearance_m`` to furniture and to
    each other; pairs closer than that at the arm's home need half of their gap there.
    """

    def __init__(self, chain: Chain, clearance_field: ClearanceField, clearance_m: float) -> None:
        self._chain = chain
        self._field = clearance_field
        moving = np.flatnonzero(chain.capsule_link > 0)
        ends, radius = chain.capsule_ends[moving], chain.capsule_radius[moving]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        all_parts, all_cover = chain.covering_balls()
        parts, cover = all_parts[moving], all_cover[moving] + clearance_m
        self._capsule = np.repeat(moving, parts + 1)
        self._share = np.concatenate([np.arange(k + 1) / max(k, 1) for k in parts] or [[]])
        self._cover = np.repeat(cover, parts + 1)
        self._moving = moving
        self._far = 0.5 * length + radius + clearance_m
        self._pairs = chain.self_pairs
        self._apart = chain.pair_needs(clearance_m)

    def gaps(self, q: Float64) -> Float64:
        """(k, g) metres to spare of every ball, then of every pair, at joint angles (k, n)."""
        ends = self._chain.capsules(q)
        return np.concatenate([self._furniture(ends), self._self(ends)], axis=-1)

    def least(self, q: Float64) -> Float64:
        """(k,) the least of the gaps at joint angles (k, n), or 0 where all are positive."""
        ends = self._chain.capsules(q)
        result = np.minimum(self._self(ends).min(axis=-1, initial=0.0), 0.0)
        middles = ends[..., self._moving, :, :].mean(axis=-2)
        spare = self._field.distance(middles.reshape(-1, 3)).reshape(middles.shape[:-1])
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
        distance = self._field.distance(centres.reshape(-1, 3))
        return np.asarray(distance.reshape(centres.shape[:-1]) - self._cover)

    def _self(self, ends: Float64) -> Float64:
        first, second = ends[..., self._pairs[:, 0], :, :], ends[..., self._pairs[:, 1], :, :]
        return np.asarray(segment_distance(first, second) - self._apart)


class ClearanceLimit(mink.Limit):
    """Limits how fast a gap may shrink, to a share of itself per step: gradient . dq <= gain gap.

    A gap that is already used up may not shrink at all.

    Attributes:
        allowance_m: metres that the links may use beyond the gaps.
    """

    def __init__(
        self, clearance: LinkClearance, qpos: NDArray[np.int32], dof: NDArray[np.int32], gain: float
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
