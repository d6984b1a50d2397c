"""Differential inverse kinematics: the commanded joint angles of one motion of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import mink
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.cartesian_path import CartesianPath
from ms_slam_env.robot.arm.chain import Chain
from ms_slam_env.robot.arm.clearance import ClearanceField, ClearanceLimit, LinkClearance
from ms_slam_env.robot.arm.feasibility import DAMPING, LIMIT_MARGIN_RAD
from ms_slam_env.robot.arm.model import ArmModel

REACHED_M, REACHED_RAD = 0.002, np.radians(0.2)
"""Largest deviation of commanded poses from their path."""

CONTROL_HZ = 20.0
"""Rate at which the differential inverse kinematics is solved."""
_SOLVED = 1  # exit flag of daqp
_GAIN = 0.5  # share of a gap to furniture or to another link that one step may use up
_LEEWAY_M = 0.002  # because gaps are checked more often here than by the mask
_NO_BOUND = 1e30  # daqp's infinity
_CHECKS = 12  # distance checks along a motion, about 1 cm apart
_LATE_TICKS = 5  # added where joint speeds made the arm late


@dataclass(frozen=True)
class Plan:
    """Commanded joint angles of one motion.

    Attributes:
        q: (k + 1, n) joint angles at the start and at the end of each tick.
        tick_s: seconds per tick.
        followed: whether the commanded camera keeps to its path and ends at the target, to 2 mm and
            0.2 deg.
        error_m: distance of the commanded camera from the target at the end.
        error_rad: angle between the two.
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
    """Follows the camera's path with the joints, tick by tick, within their limits.

    Each tick solves mink's quadratic programme for the pose at the tick's end: least squares of
    the pose's error subject to range and speed of the joints. If the links then come too close to
    furniture or to each other, the motion is planned again with those limits in the programme.
    A limit that is not active does not change the solution, so a first plan without collision is
    kept.
    """

    def __init__(
        self, model: ArmModel, chain: Chain, clearance_field: ClearanceField, config: ArmConfig
    ) -> None:
        """Control an arm.

        Args:
            model: the arm.
            chain: the model's chain, plus other parts that its links must not touch.
            clearance_field: distances to furniture around it.
            config: speeds, rate and clearance.
        """
        self._model = model
        self._chain = chain
        self._config = config
        self._configuration = mink.Configuration(model.mj)
        self._task = mink.FrameTask(model.camera_site, "site", 1.0, 1.0)
        self.clearance = LinkClearance(chain, clearance_field, config.clearance_m)
        self._lower = chain.lower + LIMIT_MARGIN_RAD
        self._upper = chain.upper - LIMIT_MARGIN_RAD
        self._up, self._down = np.zeros(model.mj.nv), np.zeros(model.mj.nv)
        self._no_rows = np.zeros((0, model.mj.nv))
        self._links = ClearanceLimit(self.clearance, model.qpos, model.dof, _GAIN)

    def plan(self, q: Float64, T_base_target: Float64, least_duration_s: float = 0.0) -> Plan:
        """Plan a motion from rest at joint angles (n,) to a camera pose (4, 4).

        Its duration follows from the camera's speed, and is at least ``least_duration_s``.
        """
        config = self._config
        path = CartesianPath(
            self._chain.camera_pose(q),
            T_base_target,
            config.speed_m_s,
            config.speed_rad_s,
            least_duration_s,
        )
        if path.duration_s == 0:
            return Plan(np.array(q)[None], 1 / CONTROL_HZ, True, 0.0, 0.0)
        plan = self._follow(path, q, [])
        spare = self.clearance.least(plan.q[checked_ticks(len(plan.q) - 1)])
        self._links.allowance_m = min(-float(spare[0]), config.clearance_m) + _LEEWAY_M
        if (spare < -self._links.allowance_m).any():
            plan = self._follow(path, q, [self._links])
        return plan

    def _follow(self, path: CartesianPath, q: Float64, limits: Sequence[mink.Limit]) -> Plan:
        ticks = max(2, int(np.ceil(path.duration_s * CONTROL_HZ - 1e-9)))
        tick_s = path.duration_s / ticks
        targets = path.at(tick_s * np.arange(1.0, ticks + 1.0))
        poses = np.concatenate(
            [
                Rotation.from_matrix(targets[:, :3, :3]).as_quat(scalar_first=True),
                targets[:, :3, 3],
            ],
            axis=1,
        )
        start = self._model.mj.qpos0.copy()
        start[self._model.qpos] = q
        self._configuration.update(start)
        data, site = self._configuration.data, self._model.camera_site
        angles, turned, moved = [np.array(q, dtype=np.float64)], [], []
        for k in range(ticks + _LATE_TICKS):
            self._task.transform_target_to_world = mink.SE3(poses[min(k, ticks - 1)])
            self._configuration.integrate_inplace(self._step(tick_s, limits), 1.0)
            angles.append(data.qpos[self._model.qpos])
            turned.append(data.site_xmat[site].copy())
            moved.append(data.site_xpos[site].copy())
            if k >= ticks - 1 and _is_close(*_apart(turned[-1:], moved[-1:], targets[-1:])):
                break
        late = len(moved) - ticks
        wanted = np.concatenate([targets, np.repeat(targets[-1:], late, axis=0)])
        off_m, off_rad = _apart(turned, moved, wanted)
        followed = _is_close(off_m, off_rad)
        return Plan(np.stack(angles), tick_s, followed, float(off_m[-1]), float(off_rad[-1]))

    def _step(self, tick_s: float, limits: Sequence[mink.Limit]) -> Float64:
        """Change (nv,) of the model's coordinates during one tick: mink's programme, solved.

        Joint range and speed are variable bounds rather than constraint rows, and daqp is called
        directly: 0.06 ms, against 0.2 ms for mink's solve_ik with its range and speed limits.
        """
        configuration, model = self._configuration, self._model
        problem = mink.build_ik(configuration, [self._task], tick_s, DAMPING, limits)
        q = configuration.data.qpos[model.qpos]
        most = self._chain.speed * tick_s
        self._up[model.dof] = np.minimum(np.maximum(self._upper - q, 0.0), most)
        self._down[model.dof] = -np.minimum(np.maximum(q - self._lower, 0.0), most)
        rows, up, down = self._no_rows, self._up, self._down
        if problem.G is not None and problem.h is not None:
            rows = problem.G
            up = np.append(up, problem.h)
            down = np.concatenate([down, np.full(len(rows), -_NO_BOUND)])
        change, _, status, _ = daqp.solve(problem.P, problem.q, rows, up, down)
        if status != _SOLVED:  # no feasible step: stay
            return np.zeros(model.mj.nv)
        return np.asarray(change)


def checked_ticks(ticks: int) -> NDArray[np.int64]:
    """The ticks of 0 to ``ticks``, both included, at whose ends distances are checked."""
    return np.linspace(0, ticks, min(ticks, _CHECKS) + 1).round().astype(np.int64)


def _apart(R: Sequence[Float64], t: Sequence[Float64], targets: Float64) -> tuple[Float64, Float64]:
    """(k,) metres and radians from k poses, R (9,) and t (3,) each, to targets (k, 4, 4)."""
    step = np.stack(t) - targets[:, :3, 3]
    turn = np.stack(R) - targets[:, :3, :3].reshape(-1, 9)
    chord = np.sqrt((turn * turn).sum(axis=1) / 8)  # |R_a - R_b| = sqrt(8) sin(angle / 2)
    return np.sqrt((step * step).sum(axis=1)), 2 * np.arcsin(np.minimum(1.0, chord))


def _is_close(off_m: Float64, off_rad: Float64) -> bool:
    return bool((off_m < REACHED_M).all() and (off_rad < REACHED_RAD).all())
