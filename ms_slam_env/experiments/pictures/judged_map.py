"""Pictures of judged maps: as SLAM coloured them, and with second copies of objects in red."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.env.point_renderer import render_points
from ms_slam_env.evaluation.duplicate_objects import JudgedMap
from ms_slam_env.experiments.pictures.drawing import Image
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.report.figures import caption, new_figure, save

Float64 = NDArray[np.float64]

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
    figure: Figure = new_figure(2, width=5.0, height=4.3)
    panels = {
        "the map": overview(judged.points, judged.colors, pose),
        "second copies in red, seen through the rest": _marked(judged, pose),
    }
    for ax, (name, image) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        ax.imshow(image)
        ax.set_title(name, fontsize="small")
        ax.axis("off")
    caption(figure, f"{title}: {describe(judged)}")
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
