"""What the planners look at, number by number, for each motion that can be chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, so3_log
from ms_slam_env.planning.expected_gain import expected_gain, look_from
from ms_slam_env.planning.occupancy_grid import OccupancyGrid
from ms_slam_env.planning.trackability import (
    NEAR_M,
    image_motion,
    mean_depth,
    remaining,
    risk_of,
    view_information,
)
from ms_slam_env.planning.view_goals import distance_in_steps
from ms_slam_env.slam.slam_backend import Views

NAMES: tuple[str, ...] = (
    *("permitted", "intensity_divergence", "depth_divergence", "criterion", "overlap", "near"),
    *("d_optimality", "weakest", "slip_risk", "gain", "goal_translation", "goal_rotation"),
    *("step_x", "step_y", "step_z", "turn_x", "turn_y", "turn_z"),
)
"""What the numbers of a candidate are, in order.

Whether it is possible; the divergences of its view as the map predicts it from that of here, in
units of M_I and M_D, and how far they are from the targets (line 9 of Algorithm 1, in these units);
the share of the view that the map fills, and the share nearer than 0.5 m; of the view's information
H (`view_information`) log(1 + det(H)^(1/6)) and log(1 + its least eigenvalue), each a pixel, in
1/m^2; the probability that SLAM slips, a frame (`trackability`); the expected gain relative to the
largest; by how many steps it leads nearer to the goal, in translation and in rotation; the motion
itself, along and about the camera's axes, in steps.
"""

_GAIN_RAYS = (8, 6)
_CAPS = dict.fromkeys(("intensity_divergence", "depth_divergence", "criterion"), 5)
_CAPS |= {"d_optimality": 20, "weakest": 20}
_BOTH_WAYS = {"goal_translation": 3, "goal_rotation": 3}
_BOTH_WAYS |= {f"{kind}_{axis}": 2 for kind in ("step", "turn") for axis in "xyz"}
HIGHS = np.array([_BOTH_WAYS.get(name, _CAPS.get(name, 1)) for name in NAMES], dtype=np.float32)
LOWS = np.array([-_BOTH_WAYS.get(name, 0) for name in NAMES], dtype=np.float32)


GRID_NAMES: tuple[str, ...] = (
    *("permitted", "gain", "occupied", "depth", "remains", "near", "slip_risk"),
    *("goal_translation", "goal_rotation"),
    *("step_x", "step_y", "step_z", "turn_x", "turn_y", "turn_z"),
)
"""What the numbers of a candidate are where one predicted view and the occupancy grid are enough.

As in ``NAMES``, but in place of a view of each candidate: the share of its rays that meet an
occupied cell, and their mean depth in units of 4 m; the share of the view from here that remains in
its image (`trackability.remaining`), that of what is then nearer than 0.5 m, and the risk to slip
where no more than that is seen.
"""

GRID_HIGHS = np.array([_BOTH_WAYS.get(name, 1) for name in GRID_NAMES], dtype=np.float32)
GRID_LOWS = np.array([-_BOTH_WAYS.get(name, 0) for name in GRID_NAMES], dtype=np.float32)
_DEPTH_SCALE_M = 4.0


@dataclass(frozen=True)
class PredictedViews:
    """What the map predicts of here, first, and of where n motions lead.

    Attributes:
        poses: (1 + n, 4, 4) T_world_camera.
        views: 1 + n.
        divergences: (n, 2) of the motions' views from that of here, in units of (M_I, M_D).
        criterion: (n,) distance to the divergences to aim at in these units, depth times lambda.
        frames: taken on a motion.
    """

    poses: Float64
    views: Views
    divergences: Float64
    criterion: Float64
    frames: int


def candidate_numbers(
    predicted: PredictedViews,
    permitted: NDArray[np.bool_],
    grid: OccupancyGrid,
    goal: Float64,
    intrinsics: Intrinsics,
    steps: tuple[float, float],
) -> tuple[Float64, float]:
    """The numbers (n, ``NAMES``) of the motions, within their bounds, and the largest gain, m^3.

    Args:
        predicted: of here and of the motions.
        permitted: (n,) which motions are possible.
        grid: what is known of space.
        goal: (4, 4) where to go.
        intrinsics: of the live camera.
        steps: translation, metres, and rotation, radians, of one motion.
    """
    poses, views = predicted.poses, predicted.views
    gain = expected_gain(grid, poses[1:], intrinsics, _GAIN_RAYS)
    H, pixels = view_information(views), views.depth[0].size
    motion_rad = image_motion(views, poses) / predicted.frames
    risk = risk_of(H, views, motion_rad, mean_depth(views)[0])
    least = np.maximum(np.linalg.eigvalsh(H)[:, 0], 0) / pixels
    d_optimality = np.exp(np.linalg.slogdet(H)[1] / 6) / pixels
    numbers = np.column_stack(
        [
            permitted,
            predicted.divergences,
            predicted.criterion,
            (views.depth > 0).mean(axis=(1, 2))[1:],
            ((views.depth > 0) & (views.depth < NEAR_M)).mean(axis=(1, 2))[1:],
            np.log1p(d_optimality)[1:],
            np.log1p(least)[1:],
            risk[1:],
            gain / max(gain.max(), 1e-9),
            *_ways(poses[0], poses[1:], goal, steps),
        ]
    )
    return np.clip(numbers, LOWS, HIGHS), float(gain.max())


def grid_numbers(
    here: Float64,
    poses: Float64,
    view: Views,
    permitted: NDArray[np.bool_],
    grid: OccupancyGrid,
    goal: Float64,
    intrinsics: Intrinsics,
    steps: tuple[float, float],
    frames: int,
) -> tuple[Float64, float]:
    """The numbers (n, ``GRID_NAMES``) of the motions, within bounds, and the largest gain, m^3.

    Args:
        here: (4, 4) where the motions begin.
        poses: (n, 4, 4) that they lead to.
        view: one, predicted from here.
        permitted: (n,) which motions are possible.
        grid: what is known of space.
        goal: (4, 4) where to go.
        intrinsics: of the live camera.
        steps: translation, metres, and rotation, radians, of one motion.
        frames: taken on a motion.
    """
    gain, depth = look_from(grid, poses, intrinsics, _GAIN_RAYS)
    H, remains, near = remaining(view, invert(here) @ poses)
    motion_rad = image_motion(view, np.concatenate([here[None], poses]))[1:] / frames
    meets = depth > 0
    numbers = np.column_stack(
        [
            permitted,
            gain / max(gain.max(), 1e-9),
            meets.mean(axis=1),
            depth.sum(axis=1) / np.maximum(meets.sum(axis=1), 1) / _DEPTH_SCALE_M,
            remains,
            near,
            risk_of(H, view, motion_rad, mean_depth(view)[0]),
            *_ways(here, poses, goal, steps),
        ]
    )
    return np.clip(numbers, GRID_LOWS, GRID_HIGHS), float(gain.max())


def _ways(
    here: Float64, poses: Float64, goal: Float64, steps: tuple[float, float]
) -> tuple[Float64, Float64, Float64]:
    """By how many steps motions lead nearer to a goal (n, 2), and the motions (n, 3) and (n, 3)."""
    motions = invert(here) @ poses
    turns = so3_log(motions[:, :3, :3])
    away = distance_in_steps(here[None], goal, *steps) - distance_in_steps(poses, goal, *steps)
    return away, motions[:, :3, 3] / steps[0], turns / steps[1]
