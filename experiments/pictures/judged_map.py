"""Pictures of maps: second copies of objects in red; the merged map of a team of robots."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from ms_slam_experiments.pictures.drawing import Image
from ms_slam_experiments.shared.teams import Team
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.env.point_renderer import render_points
from ms_slam_env.evaluation.duplicate_objects import JudgedMap
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.geometry.point_clouds import voxel_firsts
from ms_slam_env.report.figures import caption, colour, new_figure, save

CAMERA = Intrinsics(fx=460.0, fy=460.0, cx=319.5, cy=239.5, width=640, height=480)
RED = (225, 30, 30)
_NEAREST_M = 0.35  # what hangs in front of the eye would hide the rest
_DOT_M = 0.014  # the points are a centimetre apart


def save_map_picture(judged: JudgedMap, cameras: ArrayLike, path: Path, title: str) -> Path:
    """Draw a judged map twice, seen obliquely from behind the cameras that made it.

    Args:
        judged: the map and its verdict.
        cameras: (K, 3) estimated positions of the camera.
        path: of the PNG.
        title: what map this is; the verdict is appended.
    """
    pose = overview_pose(judged.points, np.asarray(cameras))
    panels = {
        "the map": overview(judged.points, judged.colors, pose),
        "second copies in red, seen through the rest": _marked(judged, pose),
    }
    return _save_pair(panels, f"{title}: {describe(judged)}", path)


def _save_pair(panels: Mapping[str, Image], text: str, path: Path) -> Path:
    """Two images with their names side by side, ``text`` below them."""
    figure = new_figure(2, width=5.0, height=4.3)
    for ax, (name, image) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        ax.imshow(image)
        ax.set_title(name, fontsize="small")
        ax.axis("off")
    caption(figure, text)
    return save(figure, path)


def _marked(judged: JudgedMap, pose: Float64) -> Image:
    """The map, faded, with the second copies drawn over what hides them."""
    faded = (0.35 * judged.colors + 0.65 * 235).astype(np.uint8)
    image = overview(judged.points, faded, pose)
    copies = judged.points[judged.consistency.apart]
    over = overview(copies, np.tile(RED, (len(copies), 1)), pose)
    return np.where((over == RED).all(axis=2, keepdims=True), over, image)


def describe(judged: JudgedMap) -> str:
    """The verdict in words, with the objects that are there twice, the worst five first."""
    twice = judged.consistency.duplicated
    if not twice:
        return "success, no object is there twice"
    names = [f"{judged.name(item)} ({100 * item.apart_share:.0f} %)" for item in twice[:5]]
    more = f" and {len(twice) - 5} more" if len(twice) > 5 else ""
    return "failure, twice there: " + ", ".join(names) + more


def overview_pose(points: Float64, cameras: Float64) -> Float64:
    """A pose (4, 4) behind and above the cameras (K, 3) that looks at the points (N, 3)."""
    target, eye = np.median(points, axis=0), cameras.mean(axis=0)
    back = eye - target
    back[2] = 0.0
    back /= max(float(np.linalg.norm(back)), 1e-6)
    return look_at(eye + 0.7 * back + np.array([0.0, 0.0, 0.5]), target)


def overview(points: Float64, colors: ArrayLike, T_world_camera: Float64) -> Image:
    """Points (N, 3) with colours (N, 3) uint8 as `CAMERA` sees them, without those near its eye."""
    ahead = transform_points(invert(T_world_camera), points)[:, 2] > _NEAREST_M
    points, shades = points[ahead], np.asarray(colors, dtype=np.uint8)[ahead]
    return render_points(CAMERA, T_world_camera, points, shades, np.full(len(points), _DOT_M))


_VOXEL_M = 0.01
_SHADE = 0.65  # of a robot's colour in the picture; the rest is the surface's own


def save_team_picture(
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
    panels = {
        name: overview(everything, np.concatenate(colors).clip(0, 255).astype(np.uint8), pose)
        for name, colors in (("the merged map", shades), ("coloured by robot", tints))
    }
    alone = float(np.mean([robot["f_score_5cm"] for robot in found["alone"]]))
    text = (
        f"{title}: {found['merged_robots']} in one frame, ATE {1e3 * found['team_ate_m']:.1f} mm, "
        f"F-score at 5 cm {100 * found['f_score_5cm']:.0f} % (alone {100 * alone:.0f} %)"
    )
    return _save_pair(panels, text, path)
