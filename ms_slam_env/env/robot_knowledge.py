"""The robot's knowledge after a step, and its state vector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.planning import OccupancyGrid
from ms_slam_env.planning.candidates import PredictedViews
from ms_slam_env.robot import NUM_ROTATIONS, NUM_TRANSLATIONS, ROTATIONS, TRANSLATIONS
from ms_slam_env.robot.action_primitives import shares_of
from ms_slam_env.slam.slam_backend import Views

STATE_NAMES: tuple[str, ...] = (
    *("x", "y", "z"),
    *("R_xx", "R_yx", "R_zx", "R_xy", "R_yy", "R_zy"),
    *("intensity_divergence", "depth_divergence"),
    *("tracking_ok", "inlier_fraction", "lost_share"),
    *(f"translation_{name}" for name in TRANSLATIONS),
    *(f"rotation_{name.replace(' ', '_')}" for name in ROTATIONS),
)
"""Names of the entries of the state vector, in order.

Position relative to the start in units of 5 m (in the start camera's frame: x right, y down, z
forward); the first two columns of the rotation, R_ij the component along i of the camera's axis j;
the divergences of the last step in units of M_I and M_D; whether SLAM tracked its last frame, the
share of pixels that it explained, and consecutive steps lost as a share of the patience; the last
motion, one-hot; of a continuous one, its share of each translation and rotation.
"""

NUM_STATE = len(STATE_NAMES)

POSITION_SCALE_M = 5.0
DIVERGENCE_CAP = 5.0  # in units of M_I, M_D
_POSITION_CAP = 200.0  # in units of 5 m: a kilometre, farther than any scene

_LOW = [-_POSITION_CAP] * 3 + [-1.0] * 6 + [0.0] * (NUM_STATE - 9)
_HIGH = [_POSITION_CAP] * 3 + [1.0] * 6 + [DIVERGENCE_CAP] * 2 + [1.0] * (NUM_STATE - 11)
STATE_BOUNDS = np.array([_LOW, _HIGH], dtype=np.float32)


@dataclass(frozen=True)
class RobotKnowledge:
    """The robot's knowledge after a step.

    Attributes:
        frame: the last live frame.
        T_start_camera: (4, 4) estimated pose relative to the start.
        divergence: (2,) of the last two live frames, in units of (M_I, M_D).
        tracking_ok: whether SLAM reports its last frame as tracked.
        inlier_fraction: share of pixels that the alignment explained.
        lost_share: consecutive steps lost, or away from the first submap, as a share of the
            patience.
        motion: index of the last motion among the 49, or among the 7 rotations where the
            translation is fixed, even if it was blocked; 0 before the first. A continuous one as a
            twist (6,), in units of a step.
        motion_mask: (n,) which motions are possible now.
        configuration: index of the current SLAM configuration; 0 where there is only one.
        lookahead: predicts the divergences (n, 2) of the candidates, in units of (M_I, M_D).
        here: (4, 4) estimated pose.
        candidates: poses (n, 4, 4) that the motions would lead to.
        view: view predicted at the current pose, at `trackability.SCALE`.
        predicted: views predicted at the current pose and the candidates, with divergences in units
            of (M_I, M_D).
        steps: translation, metres, and rotation, radians, of a motion.
        frames: number of frames taken on a motion.
        occupancy: occupancy grid; None where the observation does not need it.
    """

    frame: RGBDFrame
    T_start_camera: Float64
    divergence: Float64
    tracking_ok: bool
    inlier_fraction: float
    lost_share: float
    motion: int | Float64
    motion_mask: NDArray[np.bool_]
    configuration: int
    lookahead: Callable[[], Float64]
    here: Float64
    candidates: Callable[[], Float64]
    view: Callable[[], Views]
    predicted: Callable[[], PredictedViews]
    steps: tuple[float, float]
    frames: int
    occupancy: OccupancyGrid | None = None


def state_vector(knowledge: RobotKnowledge) -> Float32:
    """The values of ``STATE_NAMES``, (28,) float32 of order one, clipped to their bounds."""
    told = [knowledge.tracking_ok, knowledge.inlier_fraction, knowledge.lost_share]
    own = knowledge.T_start_camera, knowledge.divergence, np.array(told, dtype=np.float64)
    state = state_vectors(*own, 0 if isinstance(knowledge.motion, np.ndarray) else knowledge.motion)
    if isinstance(knowledge.motion, np.ndarray):
        state[-NUM_TRANSLATIONS - NUM_ROTATIONS :] = shares_of(knowledge.motion)
    return state


def state_vectors(
    T_start_camera: Float64, divergence: Float64, told: Float64, motion: int | NDArray[np.int64]
) -> Float32:
    """State vectors (..., 28) of one robot or several; see ``RobotKnowledge``.

    Args:
        T_start_camera: (..., 4, 4).
        divergence: (..., 2).
        told: (..., 3) ``tracking_ok``, ``inlier_fraction`` and ``lost_share``.
        motion: (...).
    """
    translation, rotation = divmod(motion, NUM_ROTATIONS)
    axes = np.swapaxes(T_start_camera[..., :3, :2], -1, -2)
    state = np.concatenate(
        [
            T_start_camera[..., :3, 3] / POSITION_SCALE_M,
            axes.reshape(*axes.shape[:-2], 6),
            divergence,
            told,
            np.eye(NUM_TRANSLATIONS)[translation],
            np.eye(NUM_ROTATIONS)[rotation],
        ],
        axis=-1,
    ).astype(np.float32)
    return np.clip(state, *STATE_BOUNDS)
