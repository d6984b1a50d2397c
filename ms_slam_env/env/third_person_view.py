"""Draw the map, the arm and the paths from outside."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Image
from ms_slam_env.camera import Intrinsics
from ms_slam_env.env.episode import Episode
from ms_slam_env.env.point_renderer import project, render_points
from ms_slam_env.geometry import look_at, transform_points
from ms_slam_env.robot import Embodiment
from ms_slam_env.robot.arm.arm import ArmEmbodiment
from ms_slam_env.robot.arm.shape import arm_parts, column_parts, surface_dots
from ms_slam_env.scenes.scene import Scene, floor_height
from ms_slam_env.slam.slam_backend import SlamBackend

TRUE_COLOR = (110, 215, 110)
ESTIMATE_COLOR = (205, 0, 40)
_OUTLINE = (20, 20, 20)
_PITCH = 0.9  # radians below the horizon
_MAP_DOT_M = 0.02
_ARM_DOT_M = 0.006
_HEADROOM_M = 0.5  # points this far above the camera's highest place would hide the rest
_FAR_SHARE = 0.005  # share of the points that may lie beyond each edge
_EDGE = 26  # pixels of margin
_ROUND_M = 0.2  # the viewpoint moves in steps of this, so that videos do not jitter
_LEAST_M = 1.0  # least distance of the viewpoint
_AMBIENT = 0.45
_TO_LIGHT = np.array([0.35, -0.3, 0.89])
_FRUSTUM_M = 0.15


def draw_third_person(
    episode: Episode, slam: SlamBackend, embodiment: Embodiment, scene: Scene, size: int
) -> tuple[Image, int]:
    """Draw the picture (size, size, 3); also return the number of map points."""
    points, truth = slam.surface_points(), episode.trajectory_truth
    low = is_low(points, episode)
    arm = arm_dots(embodiment, scene)
    must = np.concatenate([arm[0], truth[:, :3, 3], _frustum(truth[-1])])
    camera = camera_of(size, size)
    pose = point_of_view(truth[0, :3, 2], points[low], must, camera)
    picture = draw_from(camera, pose, episode, points[low], slam.surface_colors()[low], arm)
    return picture, len(points)


def camera_of(width: int, height: int) -> Intrinsics:
    """Intrinsics for a picture (height, width, 3)."""
    return Intrinsics(width, width, 0.5 * (width - 1), 0.5 * (height - 1), width, height)


def is_low(points: Float64, episode: Episode) -> NDArray[np.bool_]:
    """Which of points (N, 3) are not far above the camera's highest place."""
    highest = episode.trajectory_truth[:, 2, 3].max()
    return np.asarray(points[:, 2] < highest + _HEADROOM_M)


def draw_from(
    camera: Intrinsics,
    pose: Float64,
    episode: Episode,
    points: Float64,
    colors: Image,
    arm: tuple[Float64, Image],
) -> Image:
    """Draw a map (N, 3) in colours (N, 3), the arm's dots and both paths from a pose (4, 4)."""
    truth, estimate = episode.trajectory_truth, episode.trajectory_estimate
    arm_points, arm_colors = arm
    picture = render_points(
        camera,
        pose,
        np.concatenate([points, arm_points]),
        np.concatenate([colors, arm_colors]),
        np.repeat([_MAP_DOT_M, _ARM_DOT_M], [len(points), len(arm_points)]),
    )
    frustum = _frustum(truth[-1])
    if len(arm_points) == 0:
        for corner in frustum[1:]:
            _draw_line(picture, camera, pose, np.stack([truth[-1, :3, 3], corner]), _OUTLINE, 1)
        _draw_line(picture, camera, pose, frustum[[1, 2, 3, 4, 1]], _OUTLINE, 1)
    # the wide line stays visible on both sides of the narrow one where they run together
    for path, color, width in (
        (truth, _OUTLINE, 7),
        (truth, TRUE_COLOR, 5),
        (estimate, ESTIMATE_COLOR, 2),
    ):
        end = _draw_line(picture, camera, pose, path[:, :3, 3], color, width)
        cv2.circle(picture, end, 2 + width // 2, color, -1, cv2.LINE_AA)
    return picture


def arm_dots(arm: Embodiment, scene: Scene) -> tuple[Float64, Image]:
    """Shaded dots on the arm and its column: points and colours (N, 3); empty without an arm."""
    if not isinstance(arm, ArmEmbodiment):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    parts = arm_parts(arm.model, arm.q, arm.T_world_base)
    if arm.config.base is None:
        parts += column_parts(arm.T_world_base[:3, 3], floor_height(scene))
    points, normals, rgb = surface_dots(parts, 0.7 * _ARM_DOT_M)
    light = _AMBIENT + (1 - _AMBIENT) * np.clip(normals @ _TO_LIGHT, 0, 1)
    return points, np.clip(255 * rgb * light[:, None], 0, 255).astype(np.uint8)


def point_of_view(ahead: Float64, points: Float64, must: Float64, camera: Intrinsics) -> Float64:
    """Viewpoint from above, looking along a direction (3,), as near as everything still fits in.

    A point with coordinates (x, z) across and along the view is seen from (a, b) within the slope
    k if |x - a| <= k (z - b): the largest and smallest x -+ k z bound a and b.
    """
    heading = ahead * [1, 1, 0]
    heading = heading / max(1e-9, float(np.linalg.norm(heading)))
    forward = np.cos(_PITCH) * heading - np.sin(_PITCH) * np.array([0, 0, 1.0])
    R = look_at(np.zeros(3), forward)[:3, :3]
    eye = np.zeros(3)
    nearest = np.inf
    seen, needed = points @ R, must @ R
    for axis, pixels in enumerate((camera.width, camera.height)):
        slope = (0.5 * pixels - _EDGE) / camera.fx
        right = (seen[:, axis] - slope * seen[:, 2], needed[:, axis] - slope * needed[:, 2])
        left = (seen[:, axis] + slope * seen[:, 2], needed[:, axis] + slope * needed[:, 2])
        most, least = right[1].max(), left[1].min()
        if len(points):
            most = max(most, np.quantile(right[0], 1 - _FAR_SHARE))
            least = min(least, np.quantile(left[0], _FAR_SHARE))
        eye[axis] = 0.5 * (most + least)
        nearest = min(nearest, 0.5 * (least - most) / slope)
    nearest = min(nearest, needed[:, 2].min() - _LEAST_M)
    eye[2] = _ROUND_M * np.floor(nearest / _ROUND_M)
    eye[:2] = 0.5 * _ROUND_M * np.rint(eye[:2] / (0.5 * _ROUND_M))
    return look_at(R @ eye, R @ eye + forward)


def _frustum(T_world_camera: Float64) -> Float64:
    """A camera's centre and the four corners of a small view frustum, (5, 3)."""
    corners = np.array([(0, 0, 0), (-0.5, -0.4, 1), (0.5, -0.4, 1), (0.5, 0.4, 1), (-0.5, 0.4, 1)])
    return transform_points(T_world_camera, _FRUSTUM_M * corners)


def _draw_line(
    picture: Image,
    camera: Intrinsics,
    T_world_camera: Float64,
    points: Float64,
    color: tuple[int, int, int],
    width: int,
) -> tuple[int, int]:
    """Draw a line through points (N, 3); return the pixel of its end."""
    pixels, _ = project(camera, T_world_camera, points)
    line = np.rint(pixels).astype(np.int32)
    cv2.polylines(picture, [line], False, color, width, cv2.LINE_AA)
    return int(line[-1, 0]), int(line[-1, 1])
