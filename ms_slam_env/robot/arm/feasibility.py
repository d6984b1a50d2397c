"""Which motions of its camera an arm can make: Cartesian paths followed in joint space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env._runtime.warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.cartesian_path import PEAK_SPEED, progress
from ms_slam_env.robot.arm.chain import Chain
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.feasibility_kernels import Grid, follow, start_deficits
from ms_slam_env.robot.arm.ik_kernels import Arm, Scratch, vec6

REASONS = ("ok", "unreachable", "joint limit", "joint speed", "furniture", "self-collision")
"""Words for ``FeasibilityResult.reason``."""

FEWEST_PARTS = 7
"""Least number of parts into which a path is divided by waypoints."""

LONGEST_PART_M = 0.022
LONGEST_PART_RAD = np.radians(2.2)
"""Longer paths get more parts, so that the camera moves no more than this in each."""

MOST_STRETCH = 4.0
"""A path is refused if a joint would take more than this times the camera's duration, plus 15 %
that the controller makes up within its path tolerance and in late ticks."""

LIMIT_MARGIN_RAD = 0.02
"""Distance that planned and commanded joint angles keep from their limits."""

DAMPING = 1e-5
"""Weight of squared joint steps against the camera's squared error in metres and radians. Mask and
controller minimise the same sum, so that they bend a redundant arm the same way."""

_LEEWAY = 0.15
_STILL_S = 1e-6  # duration assigned to a path without motion


@dataclass(frozen=True)
class FeasibilityResult:
    """Feasibility of ``k`` paths.

    Attributes:
        ok: (k,) whether the arm can make the motion.
        reason: (k,) index into ``REASONS``; 0 where ok.
        q: (k, W, n) joint angles after equal parts of the duration, the first at the start of the
            path, the last at its end; only the start is valid if the motion is not ok.
        duration_s: (k,) duration of the motion, longer than the camera's where a joint needs
            longer; 0 without motion.
    """

    ok: NDArray[np.bool_]
    reason: Int32
    q: Float64
    duration_s: Float64


class Feasibility:
    """Follows Cartesian paths of the camera with the joints, and decides which are possible.

    A path is possible if at each of its waypoints inverse kinematics within the joint limits finds
    joint angles within 1.8 mm and 0.18 degrees of it (the controller allows itself 2 mm and 0.2),
    capsules around the links stay ``clearance_m`` away from furniture (beyond the slack of
    ``ClearanceField``) and from each other, and no joint needs more than ``MOST_STRETCH`` times the
    duration of the camera's path. If an arm with spare joints has several solutions for a waypoint,
    the one nearest to the waypoint before is taken. Spare joints avoid limits as in the controller,
    but unlike there not furniture or other links, so that a few possible motions are refused.

    Distances are checked so often that no link moves more than 4 cm between two checks, half of
    which the clearance covers.

    Pairs of links that are closer than the clearance at the arm's home need half that gap.

    An arm already too close, by less than the clearance, may move, but not closer: a pose reached
    with a small error must not be a trap. Standing still is always possible.
    """

    def __init__(
        self, chain: Chain, clearance_field: ClearanceField, config: ArmConfig, device: str = "cpu"
    ) -> None:
        self._chain = chain
        self._config = config
        self._device = device
        self._arm = _arm(chain, config.clearance_m, device)
        self._grid = _grid(clearance_field, device)
        self._buffers: dict[tuple[int, int], _Buffers] = {}

    def probe(
        self, q: Float64, T_base_targets: Float64, least_parts: int = FEWEST_PARTS
    ) -> FeasibilityResult:
        """Try the Cartesian paths from joint angles (n,) to camera poses (k, 4, 4)."""
        T_start = self._chain.camera_pose(q)
        targets = np.asarray(T_base_targets, dtype=np.float64)
        step = targets[:, :3, 3] - T_start[:3, 3]
        turn = Rotation.from_matrix(T_start[:3, :3].T @ targets[:, :3, :3]).as_rotvec()
        duration = PEAK_SPEED * np.maximum(
            np.linalg.norm(step, axis=1) / self._config.speed_m_s,
            np.linalg.norm(turn, axis=1) / self._config.speed_rad_s,
        )
        still = duration < _STILL_S
        size = len(targets), 1 + max(least_parts, _parts(step, turn))
        if size not in self._buffers:
            self._buffers[size] = _Buffers(*size, self._chain, self._device)
        buffers = self._buffers[size]
        buffers.fill(q, step, turn, np.maximum(duration, _STILL_S))
        wp.launch(
            start_deficits,
            dim=1,
            inputs=[
                self._arm,
                self._grid,
                buffers.scratch,
                buffers.q,
                self._config.clearance_m,
                buffers.deficit,
            ],
            device=self._device,
        )
        wp.launch(
            follow,
            dim=len(targets),
            inputs=[
                self._arm,
                self._grid,
                buffers.scratch,
                wp.mat33(T_start[:3, :3]),
                wp.vec3(T_start[:3, 3]),
                buffers.step,
                buffers.turn,
                buffers.duration,
                buffers.deficit,
                DAMPING,
                LIMIT_MARGIN_RAD,
                (1 + _LEEWAY) * MOST_STRETCH,
                buffers.share,
                buffers.q,
                buffers.stretch,
                buffers.reason,
            ],
            device=self._device,
        )
        reason = np.where(still, 0, buffers.reason.numpy()).astype(np.int32)
        ok = reason == 0
        waypoints = buffers.q.numpy().astype(np.float64)
        waypoints[still] = q
        waypoints[:, 0] = q
        seconds = np.where(still, 0.0, duration * np.where(ok, buffers.stretch.numpy(), 1.0))
        return FeasibilityResult(ok, reason, waypoints, seconds)


def _parts(step: Float64, turn: Float64) -> int:
    """Number of parts needed by the longest of paths with translations and rotations (k, 3)."""
    metres = np.linalg.norm(step, axis=1).max(initial=0.0) / LONGEST_PART_M
    radians = np.linalg.norm(turn, axis=1).max(initial=0.0) / LONGEST_PART_RAD
    return max(FEWEST_PARTS, int(np.ceil(PEAK_SPEED * max(metres, radians) - 1e-6)))


class _Buffers:
    """Device arrays for ``k`` paths of ``w`` waypoints."""

    def __init__(self, k: int, w: int, chain: Chain, device: str) -> None:
        n, m = chain.num_joints, len(chain.capsule_link)

        def array(shape: tuple[int, ...], dtype: Any) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.q = array((k, w, n), wp.float32)
        self.step = array((k,), wp.vec3)
        self.turn = array((k,), wp.vec3)
        self.duration = array((k,), wp.float32)
        self.stretch = array((k,), wp.float32)
        self.reason = array((k,), wp.int32)
        self.share = _array(progress(np.linspace(0, 1, w)), wp.float32, device)
        self.deficit = array((2,), wp.float32)
        self.scratch = Scratch()
        self.scratch.R = array((k, n + 2), wp.mat33)
        self.scratch.t = array((k, n + 2), wp.vec3)
        self.scratch.q = array((k, 1, n), wp.float32)
        self.scratch.low = array((k, n), wp.float32)
        self.scratch.high = array((k, n), wp.float32)
        self.scratch.J = array((k, n), vec6)
        self.scratch.step = array((k, n), wp.float32)
        self.scratch.held = array((k, n), wp.int32)
        self.scratch.a = array((k, max(m, 1)), wp.vec3)
        self.scratch.b = array((k, max(m, 1)), wp.vec3)
        self._start = np.zeros((k, w, n), dtype=np.float32)

    def fill(self, q: Float64, step: Float64, turn: Float64, duration: Float64) -> None:
        """Load the paths."""
        self._start[:] = q
        self.q.assign(self._start)
        self.step.assign(step.astype(np.float32))
        self.turn.assign(turn.astype(np.float32))
        self.duration.assign(duration.astype(np.float32))


@lru_cache(maxsize=16)
def _arm(chain: Chain, clearance_m: float, device: str) -> Arm:
    """The chain for the kernel, with joint frames rotated so that z is the joint axis."""
    turns = [np.eye(4)] + [_turn_to_z(axis) for axis in chain.axes]  # link frame <- turned frame
    fixed = [*chain.T_parent_joint, chain.T_last_camera]
    after = [*turns[1:], np.eye(4)]
    joints = np.stack([invert(a) @ T @ b for a, T, b in zip(turns, fixed, after, strict=True)])
    ends = chain.capsule_ends
    back = invert(np.stack(turns))[chain.capsule_link][:, :3, :3]
    ends = np.einsum("mij,mkj->mki", back, ends)
    radius = chain.capsule_radius
    parts, cover = chain.covering_balls()
    arm = Arm()
    arm.num_joints = chain.num_joints
    arm.joint_R = _array(joints[:, :3, :3], wp.mat33, device)
    arm.joint_t = _array(joints[:, :3, 3], wp.vec3, device)
    arm.lower = _array(np.maximum(chain.lower, -1e6), wp.float32, device)
    arm.upper = _array(np.minimum(chain.upper, 1e6), wp.float32, device)
    arm.speed = _array(chain.speed, wp.float32, device)
    arm.capsule_link = _array(chain.capsule_link, wp.int32, device)
    arm.capsule_a = _array(ends[:, 0], wp.vec3, device)
    arm.capsule_b = _array(ends[:, 1], wp.vec3, device)
    arm.capsule_parts = _array(parts, wp.int32, device)
    arm.capsule_need = _array(radius + clearance_m, wp.float32, device)
    arm.capsule_cover = _array(cover + clearance_m, wp.float32, device)
    arm.pair = _array(chain.self_pairs, wp.vec2i, device)
    arm.pair_need = _array(chain.pair_needs(clearance_m), wp.float32, device)
    return arm


def _grid(clearance_field: ClearanceField, device: str) -> Grid:
    """The clearance field for the kernel."""
    T = clearance_field.T_world_base
    grid = Grid()
    grid.distance = _array(clearance_field.grid, wp.float32, device)
    grid.R_grid_base = wp.mat33(T[:3, :3] / clearance_field.voxel_m)
    grid.t_grid_base = wp.vec3((T[:3, 3] - clearance_field.origin) / clearance_field.voxel_m)
    return grid


def _array(values: NDArray[Any], dtype: Any, device: str) -> Any:
    kind = np.int32 if dtype in (wp.int32, wp.vec2i) else np.float32
    return wp.array(np.ascontiguousarray(values, dtype=kind), dtype=dtype, device=device)


def _turn_to_z(axis: Float64) -> Float64:
    """A rotation (4, 4) that maps z to a unit axis (3,)."""
    aside = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(aside, axis)
    x /= np.linalg.norm(x)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    return turn
