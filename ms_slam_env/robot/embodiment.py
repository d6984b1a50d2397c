"""Interface of the embodiments that carry the camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import make_pose, so3_exp, so3_log

FRAME_PERIOD_S = 1 / 30
"""Time between frames of a camera whose carrier sets no other."""


@dataclass(frozen=True)
class MotionResult:
    """Result of one action: the camera's poses at its ``k >= 1`` frames.

    Attributes:
        made: whether the requested motion was made.
        T_world_camera: (k, 4, 4) true poses, in order of time; the last is where it ended.
        T_world_camera_kinematic: (k, 4, 4) the same poses as the carrier's kinematics report them.
        times_s: (k,) seconds since the motion began.
        energy_j: mechanical work spent, joules; 0 for a carrier without mass.
        travelled: share of the way that was free, of a motion by `Embodiment.move_by`.
    """

    made: bool
    T_world_camera: Float64
    T_world_camera_kinematic: Float64
    times_s: Float64
    energy_j: float = 0.0
    travelled: float = 1.0

    @staticmethod
    def along(
        made: bool, start: Float64, motion: Float64, frames: int = 1, travelled: float = 1.0
    ) -> MotionResult:
        """Result with ``frames`` frames, one per frame period, at exactly known poses.

        The poses move on a straight line and turn evenly, from ``start`` (4, 4) by ``motion``
        (4, 4).
        """
        shares = np.arange(1, frames) / frames
        turn = so3_log(motion[:3, :3]) if len(shares) else np.zeros(3)
        parts = [make_pose(so3_exp(share * turn), share * motion[:3, 3]) for share in shares]
        poses: Float64 = np.stack([start @ part for part in [*parts, motion]])
        times_s = FRAME_PERIOD_S * np.arange(1, frames + 1, dtype=np.float64)
        return MotionResult(made, poses, poses.copy(), times_s, travelled=travelled)


def parts_of(twist: Float64, count: int) -> tuple[Float64, Float64]:
    """The shares (count,) 1/count, 2/count, ... 1, and those shares (count, 4, 4) of a motion.

    ``twist`` (6,) is a straight translation, metres, and a rotation vector, radians.
    """
    shares = np.arange(1, count + 1) / count
    motions = [make_pose(so3_exp(share * twist[3:]), share * twist[:3]) for share in shares]
    return shares, np.stack(motions)


class HasClearance(Protocol):
    """A world with known distances: a scene, or a robot's map of it."""

    def clearance(self, points: Float64) -> Float64:
        """Distance (N,) from points (N, 3) to the nearest surface, 0 inside objects."""


class Embodiment(ABC):
    """Holds the camera in the world and executes one of ``n`` candidate motions.

    Attributes:
        T_world_camera: (4, 4) true pose of the camera.
        T_world_camera_kinematic: (4, 4) pose from the carrier's kinematics.
        num_actions: n.
    """

    T_world_camera: Float64
    num_actions: int
    _frames: int = 1

    @property
    def T_world_camera_kinematic(self) -> Float64:
        """(4, 4) pose from the carrier's kinematics; the true pose if it has no joints."""
        return self.T_world_camera

    @property
    def frames_per_motion(self) -> int:
        """Expected number of frames of a motion from here."""
        return self._frames

    @abstractmethod
    def reset(self, T_world_camera: Float64, rng: np.random.Generator) -> None:
        """Put the camera at a start pose (4, 4), or as near to it as the carrier settles.

        Raises:
            UnreachableError: the camera cannot be held there; the message says why.
        """

    @abstractmethod
    def candidate_motions(self) -> Float64:
        """The motions ``T_camera_next`` (n, 4, 4) that the actions would make from here."""

    @abstractmethod
    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) whether each motion is possible without collision."""

    def masks_in(self, world: HasClearance, T_world_camera: Float64) -> NDArray[np.bool_]:
        """(n,) action masks for a believed camera pose (4, 4) in a known ``world``.

        The carrier's own constraints, such as joint limits, apply as in ``action_masks``.
        """
        return self.action_masks()  # for a carrier whose mask does not depend on the world

    @abstractmethod
    def move(self, action: int) -> MotionResult:
        """Make motion ``action`` unless it is blocked."""

    def move_by(self, twist: Float64) -> MotionResult:
        """Move along a straight translation, metres, while turning, radians: a twist (6,).

        Where the way is blocked the motion ends before, and so does the turn.
        """
        raise NotImplementedError(f"{type(self).__name__} has no motions but its own")

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to resume bit-exactly."""

    def state_like(self) -> dict[str, Any]:
        """Template against which states are checked; NaN where a value may be missing."""
        return self.get_state()

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Resume from a state that ``get_state`` returned."""
