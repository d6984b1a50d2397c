"""What carries the camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import make_pose, so3_exp, so3_log

FRAME_PERIOD_S = 1 / 30
"""Time between frames of a camera whose carrier has no clock of its own."""


@dataclass(frozen=True)
class MotionResult:
    """What one action brought: where the camera was when its ``k >= 1`` frames were taken.

    Attributes:
        made: whether the motion that was asked for was made.
        T_world_camera: (k, 4, 4) true poses, in order of time; the last is where it ended.
        T_world_camera_kinematic: (k, 4, 4) the same poses as the carrier's kinematics report them.
        times_s: (k,) seconds since the motion began.
        energy_j: mechanical work spent, joules; 0 for a carrier without mass.
    """

    made: bool
    T_world_camera: Float64
    T_world_camera_kinematic: Float64
    times_s: Float64
    energy_j: float = 0.0

    @staticmethod
    def along(made: bool, start: Float64, motion: Float64, frames: int = 1) -> MotionResult:
        """``frames`` frames, one a frame period, at poses that are known exactly.

        On a straight line, turning evenly, from a pose (4, 4) on by a ``motion`` (4, 4).
        """
        shares = np.arange(1, frames) / frames
        turn = so3_log(motion[:3, :3]) if len(shares) else np.zeros(3)
        parts = [make_pose(so3_exp(share * turn), share * motion[:3, 3]) for share in shares]
        poses: Float64 = np.stack([start @ part for part in [*parts, motion]])
        times_s = FRAME_PERIOD_S * np.arange(1, frames + 1, dtype=np.float64)
        return MotionResult(made, poses, poses.copy(), times_s)


class HasClearance(Protocol):
    """A world of which distances are known: a scene, or a robot's map of it."""

    def clearance(self, points: Float64) -> Float64:
        """Distance (N,) from points (N, 3) to the nearest surface, 0 inside things."""


class Embodiment(ABC):
    """Holds the camera in the world and executes one of ``n`` candidate motions.

    Attributes:
        T_world_camera: (4, 4) where the camera truly is.
        T_world_camera_kinematic: (4, 4) where it is by the carrier's kinematics.
        num_actions: n.
    """

    T_world_camera: Float64
    num_actions: int
    _frames: int = 1

    @property
    def T_world_camera_kinematic(self) -> Float64:
        """(4, 4) the camera by the carrier's kinematics; the truth for a carrier without joints."""
        return self.T_world_camera

    @property
    def frames_per_motion(self) -> int:
        """Frames that a motion from here has, as far as can be known before it is made."""
        return self._frames

    @abstractmethod
    def reset(self, T_world_camera: Float64, rng: np.random.Generator) -> None:
        """Put the camera at, or as near as it settles to, a start pose (4, 4).

        Raises:
            UnreachableError: it cannot be held there; the message says why.
        """

    @abstractmethod
    def candidate_motions(self) -> Float64:
        """The motions ``T_camera_next`` (n, 4, 4) that the actions would make from here."""

    @abstractmethod
    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) whether each motion can be made without touching anything."""

    def masks_in(self, world: HasClearance, T_world_camera: Float64) -> NDArray[np.bool_]:
        """(n,) the same where the camera is believed to be at a pose (4, 4) of a known ``world``.

        What the carrier knows of itself, as its joints' limits, counts as in ``action_masks``.
        """
        return self.action_masks()  # for a carrier whose mask no world changes

    @abstractmethod
    def move(self, action: int) -> MotionResult:
        """Make motion ``action``, as far as nothing blocks it."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly."""

    def state_like(self) -> dict[str, Any]:
        """A state with which others are compared; NaN stands where there may be none."""
        return self.get_state()

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
