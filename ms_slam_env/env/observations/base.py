"""What an observation is made of: only what the robot itself has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.robot import NUM_ROTATIONS, NUM_TRANSLATIONS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_POSITION_SCALE_M = 5.0
_DIVERGENCE_CAP = 5.0  # in units of M_I, M_D
NUM_STATE = 3 + 6 + 2 + 3 + NUM_TRANSLATIONS + NUM_ROTATIONS


@dataclass(frozen=True)
class RobotKnowledge:
    """What the robot knows after a step.

    Attributes:
        frame: the last live frame.
        T_start_camera: (4, 4) estimated pose relative to the start.
        divergence: (2,) of the last two live frames, in units of (M_I, M_D).
        tracking_ok: SLAM's own word on its last frame.
        inlier_fraction: share of pixels that the alignment explained.
        lost_share: consecutive steps lost, as a share of the patience.
        motion: the last action as an index of the 49 motions, of the 7 rotations alone where the
            translation is fixed, also where it was blocked; 0 before the first.
        action_mask: (n,) which actions are possible now.
        lookahead: predicts the divergences (n, 2) of the candidates, in units of (M_I, M_D).
    """

    frame: RGBDFrame
    T_start_camera: Float64
    divergence: Float64
    tracking_ok: bool
    inlier_fraction: float
    lost_share: float
    motion: int
    action_mask: NDArray[np.bool_]
    lookahead: Callable[[], Float64]


def state_vector(knowledge: RobotKnowledge) -> Float32:
    """Pose estimate, divergences, tracking and last motion, (28,) float32 of order one.

    Position / 5 m (3), first two columns of the rotation (6), divergences / M clipped at 5 (2),
    tracking_ok, inlier fraction, lost share (3), last translation (7) and rotation (7) one-hot.
    """
    translation, rotation = divmod(knowledge.motion, NUM_ROTATIONS)
    return np.concatenate(
        [
            knowledge.T_start_camera[:3, 3] / _POSITION_SCALE_M,
            knowledge.T_start_camera[:3, :2].T.ravel(),
            np.minimum(knowledge.divergence, _DIVERGENCE_CAP),
            [knowledge.tracking_ok, knowledge.inlier_fraction, knowledge.lost_share],
            np.eye(NUM_TRANSLATIONS)[translation],
            np.eye(NUM_ROTATIONS)[rotation],
        ]
    ).astype(np.float32)


class Observation(ABC):
    """One observation variant."""

    space: gymnasium.Space[Any]

    @abstractmethod
    def build(self, knowledge: RobotKnowledge) -> Any:
        """Return the observation, an element of ``space``."""
