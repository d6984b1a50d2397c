"""Picture of the merged map of a team of robots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.experiments.harness.teams import Team
from ms_slam_env.experiments.pictures.judged_map import overview, overview_pose
from ms_slam_env.geometry import transform_points
from ms_slam_env.geometry.point_clouds import voxel_firsts
from ms_slam_env.report.figures import caption, colour, new_figure, save

Float64 = NDArray[np.float64]

_VOXEL_M = 0.01
_SHADE = 0.65  # of a robot's colour in the picture; the rest is the surface's own


def save_picture(
    team: Team, placed: dict[int, Float64], found: dict[str, Any], path: Path, title: str
) -> Path:
    """The merged map as seen obliquely from behind the cameras, as it is and coloured by robot.

    Args:
        team: the robots.
        placed: T_0_b (4, 4) by robot.
        found: figures of the team.
        path: of the PNG.
        title: what team this is.
    """
    T_world_first = team.truths[0][0]
    points, shades, tints, cameras = [], [], [], []
    for k, T_first in placed.items():
        robot, T = team.robots[k], T_world_first @ T_first
        own = transform_points(T, robot.backend.surface_points())
        kept = voxel_firsts(own, _VOXEL_M)
        color = robot.backend.surface_colors()[kept].astype(np.float64)
        tint = 255 * np.array(matplotlib.colors.to_rgb(colour(k)))
        grey = color.mean(axis=1, keepdims=True)
        points.append(own[kept])
        shades.append(color)
        tints.append(_SHADE * tint * (0.4 + 0.6 * grey / 255) + (1 - _SHADE) * grey)
        cameras.append((T @ robot.estimates)[:, :3, 3])
    everything = np.concatenate(points)
    pose = overview_pose(everything, np.concatenate(cameras))
    figure = new_figure(2, width=5.0, height=4.3)
    panels = {"the merged map": shades, "coloured by robot": tints}
    for ax, (name, colors) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        values = np.concatenate(colors).clip(0, 255).astype(np.uint8)
        ax.imshow(overview(everything, values, pose))
        ax.set_title(name, fontsize="small")
        ax.axis("off")
    alone = float(np.mean([robot["f_score_5cm"] for robot in found["alone"]]))
    caption(
        figure,
        f"{title}: {found['merged_robots']} in one frame, ATE {1e3 * found['team_ate_m']:.1f} mm, "
        f"F-score at 5 cm {100 * found['f_score_5cm']:.0f} % (alone {100 * alone:.0f} %)",
    )
    return save(figure, path)
