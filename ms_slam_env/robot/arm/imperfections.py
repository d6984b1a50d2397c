"""What keeps a real arm's camera from where its joint sensors say it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.robot.arm.config import ArmNoise

Float64 = NDArray[np.float64]

VIBRATION_PERIOD_S = 0.01
"""Torque noise is constant for so long: vibrations of up to 50 Hz."""


class Imperfections:
    """Backlash, vibration, sensor offsets and reading noise of one arm in one episode.

    The joint sensors sit on the motors' side of the gears: they see neither backlash nor their own
    zero offsets. All sizes are those of :class:`ArmNoise`; where they are zero, nothing is drawn
    away from the exact value.

    Attributes:
        T_camera_assumed: (4, 4) hand-eye error: the camera where it is taken to be, in the true
            camera's frame.
    """

    def __init__(self, noise: ArmNoise, torque_share: Float64, rng: np.random.Generator) -> None:
        """Draw an episode's errors.

        Args:
            noise: their sizes.
            torque_share: (n,) greatest torque of each joint over the greatest of all.
            rng: seeds the generator that is used from here on.
        """
        self._noise = noise
        self._torque_share = torque_share
        self._rng = np.random.default_rng(int(rng.integers(2**63)))
        n = len(torque_share)
        self._offset = self._rng.normal(0.0, noise.joint_offset_rad, n)
        turn = self._rng.normal(0.0, noise.hand_eye_rad, 3)
        self.T_camera_assumed = make_pose(so3_exp(turn), self._rng.normal(0.0, noise.hand_eye_m, 3))
        self._slack = 0.5 * noise.backlash_rad * self._rng.uniform(-1.0, 1.0, n)
        self._link: Float64 | None = None  # joint angles of the links, once they have been moved

    def link_angles(self, q_motor: Float64) -> Float64:
        """(t, n) joint angles of the links while the motors go through (t, n)."""
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
        """(k, n) what the joint sensors read at joint angles (k, n)."""
        noise = self._rng.normal(0.0, self._noise.encoder_rad, q_motor.shape)
        return q_motor + self._offset + noise

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly."""
        return {
            "random": self._rng.bit_generator.state,
            "offset": self._offset.copy(),
            "T_camera_assumed": self.T_camera_assumed.copy(),
            "slack": self._slack.copy(),
            "link": None if self._link is None else self._link.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self._rng.bit_generator.state = state["random"]
        self._offset = state["offset"].copy()
        self.T_camera_assumed = state["T_camera_assumed"].copy()
        self._slack = state["slack"].copy()
        self._link = None if state["link"] is None else state["link"].copy()


def play(x: Float64, start: Float64, half_width: float) -> Float64:
    """The play operator: outputs (t, n) of inputs (t, n), from outputs (n,) before the first.

    y_k = min(max(y_{k-1}, x_k - r), x_k + r): the output stays until an edge of the play takes it
    along (Krasnosel'skii and Pokrovskii, "Systems with Hysteresis", 1989). Steps of that kind are
    clamps, and a clamp after a clamp is a clamp, so that all are composed in log2(t) passes.
    """
    low, high = x - half_width, x + half_width
    reach = 1
    while reach < len(x):
        edges = low[reach:].copy(), high[reach:].copy()
        low[reach:] = np.minimum(np.maximum(low[:-reach], edges[0]), edges[1])
        high[reach:] = np.minimum(np.maximum(high[:-reach], edges[0]), edges[1])
        reach *= 2
    return np.clip(start, low, high)
