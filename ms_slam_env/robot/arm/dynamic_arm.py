"""An arm with physics: differential inverse kinematics commands it, MuJoCo moves it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.geometry import relative_angle, transform_points
from ms_slam_env.robot.arm.arm import ArmEmbodiment, frame_times
from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.cartesian_path import progress
from ms_slam_env.robot.arm.controller import CONTROL_HZ, Controller, Plan, checked_ticks
from ms_slam_env.robot.arm.dynamics import ArmDynamics, Imperfections, Motion
from ms_slam_env.robot.arm.feasibility import MOST_STRETCH
from ms_slam_env.robot.embodiment import MotionResult
from ms_slam_env.scenes.scene import Scene

_SETTLE_S = 1.0  # before the first frame


@dataclass(frozen=True)
class Attempt:
    """Result of a motion tried regardless of the mask.

    Attributes:
        reached: whether the command kept to the camera's path and ended at the target, to 2 mm and
            0.2 deg, and nothing stopped the arm.
        stopped: whether the arm came so close to furniture that it made a protective stop.
        error_m: distance between the camera's final and commanded positions.
        error_rad: angle between its final and commanded orientations.
        q: (t, n) joint angles of the links after every step of the physics.
    """

    reached: bool
    stopped: bool
    error_m: float
    error_rad: float
    q: Float64


class DynamicArm(ArmEmbodiment):
    """The arm with mass, servos and imperfections; the camera is where physics moves it.

    Motions are planned from the commanded joint angles, so that sag and errors do not accumulate.
    The kinematic pose follows from the joint sensors' readings.

    Attributes:
        q_command: (n,) joint angles that the servos hold.
        controller: plans motions.
        dynamics: physics.
        imperfections: of this episode.
    """

    def __init__(
        self, scene: Scene, config: ArmConfig, step_m: float, step_rad: float, timings: Timings
    ) -> None:
        super().__init__(scene, config, step_m, step_rad, timings)
        self.dynamics = ArmDynamics(self.model)
        force = self.model.mj.actuator_forcerange[self.model.actuators, 1]
        greatest = float(force.max())
        self._torque_share = force / greatest if greatest > 0 else np.ones(len(force))
        self.start_at(self.model.home, np.random.default_rng(0))

    def stand_at(self, T_world_base: Float64) -> None:
        """Move the base to a pose (4, 4) and build the clearance field around it."""
        super().stand_at(T_world_base)
        self.controller = Controller(self.model, self.chain, self.clearance_field, self.config)

    def start_at(self, q: Float64, rng: np.random.Generator) -> None:
        """Hold the arm at joint angles (n,) until it has settled under its load."""
        self.q_command = np.array(q, dtype=np.float64)
        self.imperfections = Imperfections(self.config.noise, self._torque_share, rng)
        self.dynamics.reset(self.q_command)
        self._hold(_SETTLE_S)

    @property
    def T_world_camera_kinematic(self) -> Float64:
        """(4, 4) camera pose from the last readings of the joint sensors."""
        return self._kinematic

    def planning_state(self) -> tuple[Float64, Float64]:
        """The commanded joint angles and the camera pose at them."""
        return self.q_command, self.chain.camera_pose(self.q_command)

    def move(self, action: int) -> MotionResult:
        """Make motion ``action`` if the mask allows it, else hold still for a frame."""
        probe = self.probe()
        part = self.motions[action], float(probe.duration_s[action])
        return self._execute(self._plan(*part) if probe.ok[action] else self._rest())[0]

    def move_by(self, twist: Float64) -> MotionResult:
        """Move by a twist (6,), or by the part of it that is possible; see ``free_part``."""
        share, motion, _, duration_s = self.free_part(twist)
        result, *_ = self._execute(self._plan(motion, duration_s) if share else self._rest())
        made = result.made and share == 1
        return replace(result, made=made, travelled=share * result.travelled)

    def attempt(self, action: int) -> Attempt:
        """Try motion ``action`` regardless of the mask, then restore the state.

        A masked motion gets the longest time that the mask would permit.
        """
        before, probe = self._moving_state(), self.probe()
        stretch = 1.0 if probe.ok[action] else MOST_STRETCH
        plan = self._plan(self.motions[action], stretch * float(probe.duration_s[action]))
        _, stopped, q_link = self._execute(plan)
        wanted = self.T_world_base @ self.chain.camera_pose(plan.q[-1])
        error_m = float(np.linalg.norm(self.T_world_camera[:3, 3] - wanted[:3, 3]))
        error_rad = relative_angle(self.T_world_camera[:3, :3], wanted[:3, :3])
        self._restore(before)
        self._probe = probe
        return Attempt(plan.followed and not stopped, stopped, error_m, error_rad, q_link)

    def get_state(self) -> dict[str, Any]:
        """The base pose, the physics, the errors and the random generator's state."""
        return {"T_world_base": self.T_world_base.copy(), **self._moving_state()}

    def state_like(self) -> dict[str, Any]:
        """Template of a state in which the links have not moved yet."""
        like = self.get_state()
        like["imperfections"]["link"][:] = np.nan
        return like

    def set_state(self, state: dict[str, Any]) -> None:
        """Resume from a state that ``get_state`` returned."""
        if not np.array_equal(self.T_world_base, state["T_world_base"]):
            self.stand_at(state["T_world_base"])
        self._restore(state)

    def _plan(self, motion: Float64, least_s: float) -> Plan:
        q, T_base_camera = self.planning_state()
        with self.timings.stage("ik"):
            return self.controller.plan(q, T_base_camera @ motion, least_s)

    def _rest(self) -> Plan:
        return Plan(self.q_command[None], 1 / CONTROL_HZ, False, 0.0, 0.0)

    def _execute(self, plan: Plan) -> tuple[MotionResult, bool, Float64]:
        """Follow a plan; return the result, whether the arm made a protective stop, and the joint
        angles (t, n) of the links after every step."""
        times = frame_times(plan.duration_s, self.config)
        with self.timings.stage("physics"):
            steps = np.maximum(1, np.round(times / self.dynamics.timestep_s).astype(np.int64))
            before = self._moving_state()
            motion, q_link = self._run(plan.q, plan.tick_s, int(steps[-1]))
            tick = self._first_touch(plan, q_link)
            if tick is not None:
                self._restore(before)
                plan_q = plan.q[: tick + 1]
                motion, q_link = self._run(plan_q, plan.tick_s, int(steps[-1]))
                self.q_command = plan_q[-1].copy()
            else:
                self.q_command = plan.q[-1].copy()
            at = steps - 1
            poses, kinematic = self._settle_at(motion.q[at], q_link[at])
        stopped = tick is not None
        made = plan.followed and not stopped
        seconds = steps * self.dynamics.timestep_s
        travelled = 1.0 if tick is None else float(progress(np.array(tick / (len(plan.q) - 1))))
        result = MotionResult(made, poses, kinematic, seconds, motion.energy_j, travelled)
        return result, stopped, q_link

    def _run(self, q_command: Float64, tick_s: float, steps: int) -> tuple[Motion, Float64]:
        """Physics along a command (k + 1, n), and joint angles (t, n) of the links."""
        disturbance = None
        if self.config.noise.vibration_nm > 0 and len(q_command) > 1:
            timestep = self.dynamics.timestep_s
            speed = np.vstack([np.diff(q_command, axis=0), np.zeros((1, q_command.shape[1]))])
            tick = (np.arange(steps) * timestep / tick_s).astype(np.int64)
            share = speed[np.minimum(tick, len(speed) - 1)] / tick_s / self.chain.speed
            disturbance = self.imperfections.torques(share, timestep)
        motion = self.dynamics.run(q_command, tick_s, steps, disturbance)
        return motion, self.imperfections.link_angles(motion.q)

    def _first_touch(self, plan: Plan, q_link: Float64) -> int | None:
        """The first tick that ends with a link within its radius of furniture, and nearer to it
        than at the start; None if there is none."""
        ticks = checked_ticks(len(plan.q) - 1)[1:]
        if len(ticks) == 0:
            return None
        steps = np.round(ticks * plan.tick_s / self.dynamics.timestep_s).astype(np.int64)
        index = np.clip(steps - 1, 0, len(q_link) - 1)
        clearance = self.controller.clearance
        centres = transform_points(
            self.T_world_base, clearance.balls(np.vstack([self.q, q_link[index]]))
        )
        free = self.scene.clearance(centres.reshape(-1, 3)).reshape(centres.shape[:-1])
        touches = (free < clearance.ball_radius) & (free < free[0])
        found = np.flatnonzero(touches[1:].any(axis=1))
        return int(ticks[found[0]]) if len(found) else None

    def _hold(self, seconds: float) -> None:
        """Hold the command for a time."""
        steps = int(np.ceil(seconds / self.dynamics.timestep_s))
        motion, q_link = self._run(self.q_command[None], 1.0, steps)
        self._settle_at(motion.q[-1:], q_link[-1:])

    def _settle_at(self, q_motor: Float64, q_link: Float64) -> tuple[Float64, Float64]:
        """Move to the last of joint angles (k, n); return true and read camera poses (k, 4, 4)."""
        readings = self.imperfections.readings(q_motor)
        both = self.T_world_base @ self.chain.camera_pose(np.stack([q_link, readings]))
        kinematic = both[1] @ self.imperfections.T_camera_assumed
        self._be_at(q_link[-1], both[0, -1], kinematic[-1])
        return both[0], kinematic

    def _be_at(self, q: Float64, T_world_camera: Float64, T_kinematic: Float64) -> None:
        self.q = q.copy()
        self.T_world_camera = T_world_camera.copy()
        self._kinematic = T_kinematic.copy()
        self._probe = None

    def _moving_state(self) -> dict[str, Any]:
        return {
            "q": self.q.copy(),
            "T_world_camera": self.T_world_camera.copy(),
            "q_command": self.q_command.copy(),
            "kinematic": self._kinematic.copy(),
            "physics": self.dynamics.state,
            "imperfections": self.imperfections.get_state(),
        }

    def _restore(self, state: dict[str, Any]) -> None:
        self._be_at(state["q"], state["T_world_camera"], state["kinematic"])
        self.q_command = state["q_command"].copy()
        self.dynamics.state = state["physics"]
        self.imperfections.set_state(state["imperfections"])
