"""A serial chain of hinges from the base to the camera: forward kinematics and Jacobian."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env.geometry import hat

_SHORTEST_PART_M = 0.03  # of a capsule, between two balls that cover it
_NEIGHBOURS = 2  # links this near in the chain touch by design, or joint limits keep them apart


@dataclass(frozen=True, eq=False)
class Chain:
    """Geometry of an arm with ``n`` joints and ``m`` capsules around its links.

    Link 0 is the base, link ``i`` moves with joint ``i - 1``. The frame of a moving link has its
    origin on the axis of its joint.

    Attributes:
        T_parent_joint: (n, 4, 4) frame of each joint at angle 0 in the link before it.
        axes: (n, 3) unit axis of each joint in its own frame.
        T_last_camera: (4, 4) camera in the last link: x right, y down, z forward.
        lower: (n,) lower joint limits, radians; -inf where there is none.
        upper: (n,) upper joint limits, radians; inf where there is none.
        speed: (n,) greatest joint speeds, radians a second.
        capsule_link: (m,) the link that each capsule belongs to.
        capsule_ends: (m, 2, 3) ends of its axis in the link's frame; equal ends make a ball.
        capsule_radius: (m,) metres.
        self_pairs: (p, 2) capsules that must stay apart.
        self_gap: (p,) metres between the surfaces of these pairs at the arm's home.
    """

    T_parent_joint: Float64
    axes: Float64
    T_last_camera: Float64
    lower: Float64
    upper: Float64
    speed: Float64
    capsule_link: Int32
    capsule_ends: Float64
    capsule_radius: Float64
    self_pairs: Int32
    self_gap: Float64 = field(default_factory=lambda: np.zeros(0))

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.axes)

    def link_poses(self, q: Float64) -> Float64:
        """Poses ``T_base_link`` (..., n + 1, 4, 4) of the links at joint angles (..., n)."""
        angles = np.asarray(q, dtype=np.float64)[..., None, None]
        n = self.num_joints
        turned = np.zeros((*angles.shape[:-3], n, 4, 4))
        K, K_squared = self._hats
        turned[..., :3, :3] = np.eye(3) + np.sin(angles) * K + (1 - np.cos(angles)) * K_squared
        turned[..., 3, 3] = 1
        steps = self.T_parent_joint @ turned
        poses = np.empty((*angles.shape[:-3], n + 1, 4, 4))
        poses[..., 0, :, :] = np.eye(4)
        for i in range(n):
            np.matmul(poses[..., i, :, :], steps[..., i, :, :], out=poses[..., i + 1, :, :])
        return poses

    @cached_property
    def _hats(self) -> tuple[Float64, Float64]:
        """Skew matrices (n, 3, 3) of the axes, and their squares, for Rodrigues' formula."""
        K = np.stack([hat(axis) for axis in self.axes])
        return K, K @ K

    def camera_pose(self, q: Float64) -> Float64:
        """Pose ``T_base_camera`` (..., 4, 4) at joint angles (..., n)."""
        return self.link_poses(q)[..., -1, :, :] @ self.T_last_camera

    def camera_jacobian(self, q: Float64) -> Float64:
        """(..., 6, n) linear, then angular velocity of the camera in the base frame per speed."""
        links = self.link_poses(q)[..., 1:, :, :]
        axes = np.einsum("...nij,nj->...ni", links[..., :3, :3], self.axes)
        camera = (links[..., -1, :, :] @ self.T_last_camera)[..., None, :3, 3]
        arms = camera - links[..., :3, 3]
        return np.swapaxes(np.concatenate([_cross(axes, arms), axes], axis=-1), -1, -2)

    def capsules(self, q: Float64) -> Float64:
        """Ends (..., m, 2, 3) of the capsules' axes in the base frame at joint angles (..., n)."""
        poses = self.link_poses(q)[..., self.capsule_link, :, :]  # (..., m, 4, 4)
        R, t = poses[..., :3, :3], poses[..., :3, 3]
        return np.einsum("...mij,mkj->...mki", R, self.capsule_ends) + t[..., None, :]

    def pair_gaps(self, q: Float64, pairs: Int32) -> Float64:
        """Metres (..., p) between the surfaces of pairs (p, 2) of capsules at angles (..., n)."""
        ends, radius = self.capsules(q), self.capsule_radius
        first, second = pairs[:, 0], pairs[:, 1]
        gap = segment_distance(ends[..., first, :, :], ends[..., second, :, :])
        return gap - radius[first] - radius[second]

    def pair_needs(self, clearance_m: float) -> Float64:
        """Distances (p,) that the axes of ``self_pairs`` keep: half the gap at home if less."""
        apart = np.minimum(clearance_m, 0.5 * self.self_gap)
        return self.capsule_radius[self.self_pairs].sum(axis=1) + apart

    def covering_balls(self) -> tuple[Int32, Float64]:
        """Number of parts (m,) into which each capsule's axis is cut, and the radius (m,) at which
        balls around the ends of the parts contain the whole capsule."""
        length = np.linalg.norm(self.capsule_ends[:, 1] - self.capsule_ends[:, 0], axis=1)
        longest = np.maximum(self.capsule_radius, _SHORTEST_PART_M)
        parts = np.ceil(length / longest - 1e-6).astype(np.int32)
        return parts, np.hypot(self.capsule_radius, 0.5 * length / np.maximum(parts, 1))

    def within_limits(self, q: Float64, margin_rad: float = 0.0) -> NDArray[np.bool_]:
        """(...,) whether joint angles (..., n) keep ``margin_rad`` from every limit."""
        inside = (q >= self.lower + margin_rad) & (q <= self.upper - margin_rad)
        return np.asarray(inside.all(axis=-1))


def _cross(a: Float64, b: Float64) -> Float64:
    """Cross products (..., 3); twice as fast as NumPy's for a few vectors."""
    a_next, b_next = a[..., [1, 2, 0]], b[..., [1, 2, 0]]
    return (a * b_next - a_next * b)[..., [1, 2, 0]]


def segment_distance(a: Float64, b: Float64) -> Float64:
    """Distances (...,) between segments ``a`` and ``b`` (..., 2, 3).

    Lumelsky's closest points by clamping (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    d1, d2 = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :]
    r = a[..., 0, :] - b[..., 0, :]
    tiny = 1e-12
    aa, ee = (d1 * d1).sum(-1), (d2 * d2).sum(-1)
    bb, cc, ff = (d1 * d2).sum(-1), (d1 * r).sum(-1), (d2 * r).sum(-1)
    denominator = aa * ee - bb * bb
    parallel = denominator <= tiny * aa * ee
    s = np.where(parallel, 0.0, (bb * ff - cc * ee) / np.where(parallel, 1.0, denominator))
    s = np.clip(s, 0.0, 1.0)
    ball = ee <= tiny  # b is a point: t has no meaning, s is that of the nearest point of a
    t = np.where(ball, 0.0, (bb * s + ff) / np.maximum(ee, tiny))
    clamped = np.clip(t, 0.0, 1.0)
    again = np.clip((bb * clamped - cc) / np.maximum(aa, tiny), 0.0, 1.0)
    s = np.where((t == clamped) & ~ball, s, again)
    gap = r + d1 * s[..., None] - d2 * clamped[..., None]
    return np.sqrt((gap * gap).sum(-1))


def separate_pairs(chain: Chain, home: Float64) -> Chain:
    """Add ``self_pairs``: capsules more than two links apart that do not touch at ``home``."""
    m = len(chain.capsule_link)
    first, second = np.triu_indices(m, 1)
    far = np.abs(chain.capsule_link[first] - chain.capsule_link[second]) > _NEIGHBOURS
    pairs = np.stack([first[far], second[far]], axis=1).astype(np.int32)
    gap = chain.pair_gaps(home, pairs)
    return dataclasses.replace(chain, self_pairs=pairs[gap > 0], self_gap=gap[gap > 0])


def with_column(chain: Chain, home: Float64, radius_m: float, height_m: float) -> Chain:
    """Add an upright column below the base that the links must not touch."""
    column = np.array([[[0.0, 0.0, -radius_m], [0.0, 0.0, -max(height_m, radius_m)]]])
    extended = dataclasses.replace(
        chain,
        capsule_link=np.append(chain.capsule_link, 0).astype(np.int32),
        capsule_ends=np.concatenate([chain.capsule_ends, column]),
        capsule_radius=np.append(chain.capsule_radius, radius_m),
    )
    return separate_pairs(extended, home)
