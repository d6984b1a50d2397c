"""An arm's physics, and the imperfections between its true and measured camera pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.robot.arm.arm_config import ArmNoise
from ms_slam_env.robot.arm.model import ArmModel

_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED)


@dataclass(frozen=True)
class Motion:
    """Simulated response to a command, after each of ``t`` steps.

    Attributes:
        q: (t, n) joint angles.
        velocity: (t, n) radians per second.
        torque: (t, n) of the motors, Nm, gravity compensation included.
        energy_j: integral of |torque x velocity|, summed over the joints: mechanical work of
            motors that recover nothing.
    """

    q: Float64
    velocity: Float64
    torque: Float64
    energy_j: float


class ArmDynamics:
    """MuJoCo's simulation of an arm whose position servos follow a command.

    The command is smoothed between ticks, and each servo also gets its velocity, as in industrial
    arms. The remaining errors come from inertia, friction and the load that gravity compensation
    does not model. All steps of a motion are one native call of MuJoCo's ``Batch``, a fifth faster
    than single steps; its state row is the whole state. Each environment has its own ``Batch``:
    several arms in one cost as much on one thread as one after another.
    """

    def __init__(self, model: ArmModel) -> None:
        mj = model.mj
        self._model = model
        self.timestep_s = float(mj.opt.timestep)
        self._batch = Batch(mj, 1, nthread=1)
        self._rest = _holding_controls(mj)
        actuators = model.actuators
        self._gear = mj.actuator_gear[actuators, 0].copy()
        self._gain = mj.actuator_gainprm[actuators, 0].copy()
        self._bias = mj.actuator_biasprm[actuators, :3].copy()
        self._passive_support = ~mj.jnt_actgravcomp[mj.dof_jntid[model.dof]].astype(bool)

    def reset(self, q: Float64) -> None:
        """Hold the arm, at rest, at joint angles (n,)."""
        self._batch.reset(stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._batch.qpos[0] = self._model.mj.qpos0
        self._batch.qpos[0, self._model.qpos] = q
        self._batch.ctrl[0] = self._rest

    @property
    def state(self) -> Float64:
        """MuJoCo's integration state, a copy."""
        return np.array(self._batch.state[0])

    @state.setter
    def state(self, value: Float64) -> None:
        self._batch.state[0] = value

    def run(
        self, q_command: Float64, tick_s: float, steps: int, disturbance: Float64 | None = None
    ) -> Motion:
        """Step the arm along commanded joint angles.

        Args:
            q_command: (k + 1, n) joint angles at the ends of k >= 0 ticks; the last are then held.
            tick_s: seconds per tick.
            steps: t >= 1 physics steps.
            disturbance: (t, n) torque on the joints, Nm.
        """
        model, mj = self._model, self._model.mj
        times = self.timestep_s * np.arange(float(steps))  # when the steps begin
        q, velocity = smooth(q_command, tick_s, times)
        inputs = np.zeros((1, steps, mj.nu + mj.nv))
        inputs[0, :, : mj.nu] = self._rest
        inputs[0, :, model.actuators] = self._controls(q, velocity).T
        if disturbance is not None:
            inputs[0, :, mj.nu + model.dof] = disturbance.T
        before = self._batch.qvel[0, model.dof]
        record = ("qpos", "qvel", "qfrc_actuator", "qfrc_gravcomp")
        out = self._batch.rollout(steps, inputs, _INPUTS, record=record)
        speed = out["qvel"][0][:, model.dof]
        torque = out["qfrc_actuator"][0][:, model.dof]
        torque += self._passive_support * out["qfrc_gravcomp"][0][:, model.dof]
        mean_speed = 0.5 * (speed + np.vstack([before, speed[:-1]]))
        energy = float(np.abs(torque * mean_speed).sum() * self.timestep_s)
        return Motion(out["qpos"][0][:, model.qpos], speed, torque, energy)

    def _controls(self, q: Float64, velocity: Float64) -> Float64:
        """Controls (t, n) at which the servos exert no force at joint states (t, n).

        MuJoCo's affine actuator: force = gain u + b0 + b1 gear q + b2 gear dq/dt.
        """
        b0, b1, b2 = self._bias.T
        return -(b0 + b1 * self._gear * q + b2 * self._gear * velocity) / self._gain


def smooth(q: Float64, tick_s: float, times: Float64) -> tuple[Float64, Float64]:
    """Joint angles and velocities (t, n) at times (t,) through (k + 1, n) at the ends of ticks.

    Cubic Hermite splines with central differences as velocities, at rest before and after.
    """
    ticks = len(q) - 1
    if ticks == 0:
        return np.repeat(q, len(times), axis=0), np.zeros((len(times), q.shape[1]))
    slope = np.zeros_like(q)
    slope[1:-1] = 0.5 * (q[2:] - q[:-2])
    place = np.clip(times / tick_s, 0, ticks)
    index = np.minimum(place.astype(np.int64), ticks - 1)
    s = (place - index)[:, None]
    a, b, da, db = q[index], q[index + 1], slope[index], slope[index + 1]
    rise = b - a
    c2, c3 = 3 * rise - 2 * da - db, da + db - 2 * rise
    return a + s * (da + s * (c2 + s * c3)), (da + s * (2 * c2 + 3 * s * c3)) / tick_s


def _holding_controls(mj: mujoco.MjModel) -> Float64:
    """Controls (nu,) that hold every joint with a position actuator at its initial position."""
    controls = np.zeros(mj.nu)
    for actuator in range(mj.nu):
        b0, b1 = mj.actuator_biasprm[actuator, :2]
        on_joint = mj.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        gain = mj.actuator_gainprm[actuator, 0]
        if on_joint and b1 < 0 and gain != 0:
            start = mj.qpos0[mj.jnt_qposadr[mj.actuator_trnid[actuator, 0]]]
            controls[actuator] = -(b0 + b1 * mj.actuator_gear[actuator, 0] * start) / gain
    return controls


VIBRATION_PERIOD_S = 0.01
"""Time for which torque noise is constant: vibrations of up to 50 Hz."""


class Imperfections:
    """Backlash, vibration, sensor offsets and reading noise of one arm in one episode.

    The joint sensors sit on the motor side of the gears: they see neither backlash nor their own
    zero offsets. The sizes are those of :class:`ArmNoise`; where they are zero, values are exact.

    Attributes:
        T_camera_assumed: (4, 4) hand-eye error: the assumed camera in the true camera's frame.
    """

    def __init__(self, noise: ArmNoise, torque_share: Float64, rng: np.random.Generator) -> None:
        """Draw an episode's errors.

        Args:
            noise: sizes of the errors.
            torque_share: (n,) greatest torque of each joint over the greatest of all.
            rng: seeds the generator used from then on.
        """
        self._noise = noise
        self._torque_share = torque_share
        self._rng = np.random.default_rng(int(rng.integers(2**63)))
        n = len(torque_share)
        self._offset = self._rng.normal(0.0, noise.joint_offset_rad, n)
        turn = self._rng.normal(0.0, noise.hand_eye_rad, 3)
        self.T_camera_assumed = make_pose(so3_exp(turn), self._rng.normal(0.0, noise.hand_eye_m, 3))
        self._slack = 0.5 * noise.backlash_rad * self._rng.uniform(-1.0, 1.0, n)
        self._link: Float64 | None = None  # joint angles of the links, once they have moved

    def link_angles(self, q_motor: Float64) -> Float64:
        """(t, n) joint angles of the links while the motors move through (t, n)."""
        before = q_motor[0] + self._slack if self._link is None else self._link
        q = play(q_motor, before, 0.5 * self._noise.backlash_rad)
        self._link = q[-1].copy()
        return q

    def torques(self, speed_share: Float64, timestep_s: float) -> Float64:
        """(t, n) torque noise at joint speeds (t, n) given as shares of the greatest ones."""
        steps, n = speed_share.shape
        index = (np.arange(steps) * timestep_s / VIBRATION_PERIOD_S + 1e-9).astype(np.int64)
        drawn = self._rng.normal(0.0, self._noise.vibration_nm, (int(index[-1]) + 1, n))
        return np.abs(speed_share) * self._torque_share * drawn[index]

    def readings(self, q_motor: Float64) -> Float64:
        """(k, n) readings of the joint sensors at joint angles (k, n)."""
        noise = self._rng.normal(0.0, self._noise.encoder_rad, q_motor.shape)
        return q_motor + self._offset + noise

    def get_state(self) -> dict[str, Any]:
        """Everything needed to resume bit-exactly."""
        return {
            "random": self._rng.bit_generator.state,
            "offset": self._offset.copy(),
            "T_camera_assumed": self.T_camera_assumed.copy(),
            "slack": self._slack.copy(),
            "link": np.full_like(self._slack, np.nan) if self._link is None else self._link.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Resume from a state that ``get_state`` returned."""
        self._rng.bit_generator.state = state["random"]
        self._offset = state["offset"].copy()
        self.T_camera_assumed = state["T_camera_assumed"].copy()
        self._slack = state["slack"].copy()
        self._link = None if np.isnan(state["link"]).any() else state["link"].copy()


def play(x: Float64, start: Float64, half_width: float) -> Float64:
    """The play operator: outputs (t, n) of inputs (t, n), from outputs (n,) before the first.

    y_k = min(max(y_{k-1}, x_k - r), x_k + r): the output stays until an edge of the play moves it
    (Krasnosel'skii and Pokrovskii, "Systems with Hysteresis", 1989). Each step is a clamp, and
    clamps compose to clamps, so all steps are composed in log2(t) passes.
    """
    low, high = x - half_width, x + half_width
    reach = 1
    while reach < len(x):
        edges = low[reach:].copy(), high[reach:].copy()
        low[reach:] = np.minimum(np.maximum(low[:-reach], edges[0]), edges[1])
        high[reach:] = np.minimum(np.maximum(high[:-reach], edges[0]), edges[1])
        reach *= 2
    return np.clip(start, low, high)
