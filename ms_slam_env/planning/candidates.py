"""The values by which planners rate each candidate motion."""

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
"""Names of the values of a candidate, in order.

Whether it is possible; the divergences of its predicted view from that at the current pose, in
units of M_I and M_D, and their distance from the targets (line 9 of Algorithm 1, in these units);
the share of the view that the map fills, and the share nearer than 0.5 m; log(1 + det(H)^(1/6)) and
log(1 + least eigenvalue of H), H the view's information (`view_information`) per pixel, in 1/m^2;
the probability that SLAM slips, per frame (`trackability`); the expected gain relative to the
largest; the number of steps by which it comes nearer to the goal, in translation and in rotation;
the motion itself, along and about the camera's axes, in steps.
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
"""Names of the values of a candidate, from one predicted view and the occupancy grid alone.

As in ``NAMES``, but in place of a predicted view of each candidate: the share of its rays that hit
an occupied cell, and their mean depth in units of 4 m; the share of the current view that remains
in its image (`trackability.remaining`), the share of that nearer than 0.5 m, and the slip risk if
nothing else is seen.
"""

GRID_HIGHS = np.array([_BOTH_WAYS.get(name, 1) for name in GRID_NAMES], dtype=np.float32)
GRID_LOWS = np.array([-_BOTH_WAYS.get(name, 0) for name in GRID_NAMES], dtype=np.float32)
_DEPTH_SCALE_M = 4.0


@dataclass(frozen=True)
class PredictedViews:
    """Views predicted at the current pose, first, and at the ends of n motions.

    Attributes:
        poses: (1 + n, 4, 4) T_world_camera.
        views: the 1 + n views.
        divergences: (n, 2) of the motions' views from the current one, in units of (M_I, M_D).
        criterion: (n,) distance to the target divergences in these units, depth times lambda.
        frames: number of frames taken on a motion.
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
    """The values (n, ``NAMES``) of the motions, within their bounds, and the largest gain, m^3.

    Args:
        predicted: views at the current pose and after the motions.
        permitted: (n,) which motions are possible.
        grid: the known occupancy.
        goal: (4, 4) goal pose.
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
    """The values (n, ``GRID_NAMES``) of the motions, within bounds, and the largest gain, m^3.

    Args:
        here: (4, 4) pose at which the motions begin.
        poses: (n, 4, 4) poses that they lead to.
        view: one view, predicted from ``here``.
        permitted: (n,) which motions are possible.
        grid: the known occupancy.
        goal: (4, 4) goal pose.
        intrinsics: of the live camera.
        steps: translation, metres, and rotation, radians, of one motion.
        frames: number of frames taken on a motion.
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
    """Steps by which motions come nearer to a goal (n, 2), and the motions (n, 3) and (n, 3)."""
    motions = invert(here) @ poses
    turns = so3_log(motions[:, :3, :3])
    away = distance_in_steps(here[None], goal, *steps) - distance_in_steps(poses, goal, *steps)
    return away, motions[:, :3, 3] / steps[0], turns / steps[1]
