"""Differential inverse kinematics: the commanded joint angles of one motion of the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import mink
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env.robot.arm.clearance import Clearance, ClearanceLimit, JointLimit
from ms_slam_env.robot.arm.config import ArmConfig
from ms_slam_env.robot.arm.model import ArmModel
from ms_slam_env.robot.arm.path import CameraPath
from ms_slam_env.robot.arm.surroundings import Surroundings

Float64 = NDArray[np.float64]

REACHED_M, REACHED_RAD = 0.002, np.radians(0.2)
"""Furthest that commanded poses may be from their way."""

LIMIT_MARGIN_RAD = 0.02
"""Distance that commanded joint angles keep from their limits."""

_SOLVED = 1  # exit flag of daqp
_DAMPING = 1e-5  # in square metres and radians: keeps steps small where the arm is nearly singular
_GAIN = 0.5  # share of a gap to furniture or to another link that one step may use up
_LEEWAY_M = 0.002  # gaps are checked oftener here than by the mask
_LATE_TICKS = 5  # added where joint speeds made the arm late


@dataclass(frozen=True)
class Plan:
    """Commanded joint angles of one motion.

    Attributes:
        q: (k + 1, n) joint angles at the start and at the end of each tick.
        tick_s: seconds a tick.
        followed: the commanded camera keeps to its way and ends at the target, to 2 mm, 0.2 deg.
        error_m: distance of the commanded camera to the target at the end.
        error_rad: angle of the same.
    """

    q: Float64
    tick_s: float
    followed: bool
    error_m: float
    error_rad: float

    @property
    def duration_s(self) -> float:
        """Seconds from first to last."""
        return (len(self.q) - 1) * self.tick_s


class Controller:
    """Follows the camera's way with the joints, tick by tick, within their limits.

    Each tick solves mink's quadratic programme for the pose at the tick's end: least squares of
    the pose's error subject to range and speed of the joints. If the links then come too close to
    furniture or to each other, the motion is planned again with those limits in the programme; a
    limit that does not bind does not change its solution, so the first plan stands where it is
    legal.
    """

    def __init__(self, model: ArmModel, surroundings: Surroundings, config: ArmConfig) -> None:
        self._model = model
        self._config = config
        self._configuration = mink.Configuration(model.mj)
        self._task = mink.FrameTask(model.camera_site, "site", 1.0, 1.0)
        self.clearance = Clearance(model.chain, surroundings, config.clearance_m)
        self._joints = JointLimit(model.chain, model.qpos, model.dof, model.mj.nv, LIMIT_MARGIN_RAD)
        self._links = ClearanceLimit(self.clearance, model.qpos, model.dof, _GAIN)

    def plan(self, q: Float64, T_base_target: Float64, least_duration_s: float = 0.0) -> Plan:
        """Plan a motion from rest at joint angles (n,) to a camera pose (4, 4).

        It lasts as long as the camera's speed asks for, at least ``least_duration_s``.
        """
        config = self._config
        path = CameraPath(
            self._model.chain.camera_pose(q),
            T_base_target,
            config.speed_m_s,
            config.speed_rad_s,
            least_duration_s,
        )
        if path.duration_s == 0:
            return Plan(np.array(q)[None], 1 / config.control_hz, True, 0.0, 0.0)
        plan = self._follow(path, q, [self._joints])
        spare = self.clearance.least(plan.q)
        self._links.allowance_m = min(-float(spare[0]), config.clearance_m) + _LEEWAY_M
        if (spare < -self._links.allowance_m).any():
            plan = self._follow(path, q, [self._joints, self._links])
        return plan

    def _follow(self, path: CameraPath, q: Float64, limits: Sequence[mink.Limit]) -> Plan:
        ticks = max(2, int(np.ceil(path.duration_s * self._config.control_hz - 1e-9)))
        tick_s = path.duration_s / ticks
        targets = path.at(tick_s * np.arange(1.0, ticks + 1.0))
        poses = np.concatenate(
            [
                Rotation.from_matrix(targets[:, :3, :3]).as_quat(scalar_first=True),
                targets[:, :3, 3],
            ],
            axis=1,
        )
        configuration, data = self._configuration, self._configuration.data
        start = self._model.mj.qpos0.copy()
        start[self._model.qpos] = q
        configuration.update(start)
        angles = [np.array(q, dtype=np.float64)]
        furthest = (0.0, 0.0)
        for k in range(ticks + _LATE_TICKS):
            at = min(k, ticks - 1)
            self._task.transform_target_to_world = mink.SE3(poses[at])
            configuration.integrate_inplace(self._step(tick_s, limits), 1.0)
            angles.append(data.qpos[self._model.qpos])
            left = self._left(targets[at])
            furthest = (max(furthest[0], left[0]), max(furthest[1], left[1]))
            if k >= ticks - 1 and left[0] < REACHED_M and left[1] < REACHED_RAD:
                break
        followed = furthest[0] < REACHED_M and furthest[1] < REACHED_RAD
        return Plan(np.stack(angles), tick_s, followed, *left)

    def _step(self, tick_s: float, limits: Sequence[mink.Limit]) -> Float64:
        """Change (nv,) of the model's coordinates during one tick: mink's programme, solved.

        Without mink's and qpsolvers' own checks and conversions, a third of the time.
        """
        problem = mink.build_ik(self._configuration, [self._task], tick_s, _DAMPING, limits)
        change, _, status, _ = daqp.solve(problem.P, problem.q, problem.G, problem.h)
        if status != _SOLVED:  # the limits leave no way to go: stay
            return np.zeros(self._model.mj.nv)
        return np.asarray(change)

    def _left(self, T_base_target: Float64) -> tuple[float, float]:
        """Metres and radians from the camera to a pose (4, 4)."""
        data, site = self._configuration.data, self._model.camera_site
        step = data.site_xpos[site] - T_base_target[:3, 3]
        turn = (data.site_xmat[site].reshape(3, 3) - T_base_target[:3, :3]).ravel()
        chord = math.sqrt(turn @ turn / 8)  # |R_a - R_b| = sqrt(8) sin(angle / 2)
        return math.sqrt(step @ step), 2 * math.asin(min(1.0, chord))
