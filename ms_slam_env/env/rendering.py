"""One composed picture that explains the moment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, look_at, transform_points
from ms_slam_env.robot import describe
from ms_slam_env.robot.arm.arm_base import ArmEmbodiment

if TYPE_CHECKING:
    from ms_slam_env.env.active_slam import ActiveSlamEnv

Image = NDArray[np.uint8]
Float64 = NDArray[np.float64]

_PANEL = (240, 320)  # (height, width) of the live images
_MAP = (480, 480)
_PLOT = (160, 320)
_TRUE_COLOR = (60, 180, 75)
_ESTIMATE_COLOR = (230, 60, 60)
_TARGET_COLOR = (120, 120, 120)
_LINK_COLOR = (40, 40, 45)
_JOINT_COLOR = (235, 160, 40)
_BASE_RADIUS_M = 0.08
_NEAREST_M = 0.1  # what is nearer to the point of view is not drawn
_BACKGROUND = 250
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_DEPTH_M = 5.0
_OUTSIDE_PITCH = 0.9  # radians below the horizon
_ERROR_AXIS_M = 0.01
_DIVERGENCE_AXIS = 2.0  # the plots end at this many times M


class Renderer:
    """Draws colour, depth, map from outside, divergences against targets, error so far."""

    def draw(self, env: ActiveSlamEnv) -> Image:
        """Return the picture (480, 1120, 3) uint8 of an environment that was reset."""
        left = np.vstack([self._color(env), self._depth(env)])
        right = np.vstack(self._plots(env))
        return np.hstack([left, self._map(env), right])

    def _color(self, env: ActiveSlamEnv) -> Image:
        image = cv2.resize(env.last_frame.color, _PANEL[::-1])
        frame = len(env.trajectory_truth) - 1
        state = "" if env.tracking_ok else ", TRACKING LOST"
        return _caption(image, f"{env.scene.name} {frame}: {describe(env.last_motion)}{state}")

    def _depth(self, env: ActiveSlamEnv) -> Image:
        depth = env.last_frame.depth
        grey = (255 * (1 - np.clip(depth / _MAX_DEPTH_M, 0, 1))).astype(np.uint8)
        colored = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
        colored[depth == 0] = 0
        image = cv2.resize(colored, _PANEL[::-1], interpolation=cv2.INTER_NEAREST)
        return _caption(image, f"depth, 0 to {_MAX_DEPTH_M:g} m, black: no reading")

    def _map(self, env: ActiveSlamEnv) -> Image:
        truth = env.trajectory_truth
        camera = Intrinsics(fx=420, fy=420, cx=239.5, cy=239.5, width=_MAP[1], height=_MAP[0])
        T_world_outside = _outside_pose(env)
        canvas = np.full((*_MAP, 3), _BACKGROUND, np.uint8)
        points, colors = env.slam.surface_points(), env.slam.surface_colors()
        _splat(canvas, camera, T_world_outside, points, colors)
        if isinstance(env.embodiment, ArmEmbodiment):
            _draw_arm(canvas, camera, T_world_outside, env.embodiment)
        estimate = env.trajectory_estimate
        _draw_path(canvas, camera, T_world_outside, truth, _TRUE_COLOR, width=4)
        _draw_path(canvas, camera, T_world_outside, estimate, _ESTIMATE_COLOR, width=1)
        return _caption(canvas, f"map: {len(points)} points; path: true green, estimated red")

    def _plots(self, env: ActiveSlamEnv) -> list[Image]:
        divergences = env.divergences
        targets = env.config.targets
        errors = np.asarray(env.pose_errors)
        rows = [
            (
                divergences[:, 0],
                targets.divergence[0],
                _DIVERGENCE_AXIS * targets.M_I,
                "intensity divergence",
            ),
            (
                divergences[:, 1],
                targets.divergence[1],
                _DIVERGENCE_AXIS * targets.M_D,
                "depth divergence",
            ),
            (errors, None, max(_ERROR_AXIS_M, errors.max()), "pose error (m)"),
        ]
        return [_plot(*row) for row in rows]


def _outside_pose(env: ActiveSlamEnv) -> Float64:
    """A view from above and behind the start, far enough to see what the camera can map."""
    start = env.trajectory_truth[0]
    heading = start[:3, 2] * [1, 1, 0]
    heading = heading / max(1e-9, float(np.linalg.norm(heading)))
    ahead, distance = (0.4, 2.8) if isinstance(env.embodiment, ArmEmbodiment) else (1.2, 5.0)
    centre = start[:3, 3] + ahead * heading - [0, 0, 0.4]
    offset = -np.cos(_OUTSIDE_PITCH) * heading + np.sin(_OUTSIDE_PITCH) * np.array([0, 0, 1.0])
    return look_at(centre + distance * offset, centre)


def _project(
    camera: Intrinsics, T_world_camera: Float64, points: Float64
) -> tuple[Float64, Float64]:
    local = transform_points(invert(T_world_camera), points)
    in_front = local[:, 2] > _NEAREST_M
    pixels = np.full((len(local), 2), -1.0)
    pixels[in_front] = camera.project(local[in_front])
    return pixels, local[:, 2]


def _splat(
    canvas: Image, camera: Intrinsics, T_world_camera: Float64, points: Float64, colors: Image
) -> None:
    """Paint points back to front as 2 x 2 pixels."""
    pixels, depth = _project(camera, T_world_camera, points)
    order = np.argsort(-depth)
    u, v = np.rint(pixels[order]).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width - 1) & (v < camera.height - 1)
    u, v, rgb = u[inside], v[inside], colors[order][inside]
    for dv in (0, 1):
        for du in (0, 1):
            canvas[v + dv, u + du] = rgb


def _draw_path(
    canvas: Image,
    camera: Intrinsics,
    T_world_camera: Float64,
    poses: Float64,
    color: tuple[int, int, int],
    width: int,
) -> None:
    pixels, _ = _project(camera, T_world_camera, poses[:, :3, 3])
    line = np.rint(pixels).astype(np.int32)
    cv2.polylines(canvas, [line], False, color, width, cv2.LINE_AA)
    cv2.circle(canvas, (int(line[-1, 0]), int(line[-1, 1])), 2 + width, color, -1, cv2.LINE_AA)


def _draw_arm(
    canvas: Image, camera: Intrinsics, T_world_camera: Float64, arm: ArmEmbodiment
) -> None:
    """Links as lines from joint to joint and on to the camera, the base as a disc."""
    angles = np.linspace(0, 2 * np.pi, 24)
    rim = _BASE_RADIUS_M * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    links = arm.model.chain.link_poses(arm.q)[:, :3, 3]
    joints = np.vstack([transform_points(arm.T_world_base, links), arm.T_world_camera[:3, 3]])
    disc, depth = _project(camera, T_world_camera, transform_points(arm.T_world_base, rim))
    line, line_depth = _project(camera, T_world_camera, joints)
    if min(depth.min(), line_depth.min()) <= _NEAREST_M:
        return  # partly behind the point of view
    cv2.fillConvexPoly(canvas, np.rint(disc).astype(np.int32), _LINK_COLOR, cv2.LINE_AA)
    corners = np.rint(line).astype(np.int32)
    cv2.polylines(canvas, [corners], False, _LINK_COLOR, 5, cv2.LINE_AA)
    for u, v in corners[1:-1].tolist():
        cv2.circle(canvas, (u, v), 3, _JOINT_COLOR, -1, cv2.LINE_AA)


def _plot(values: Float64, target: float | None, top: float, title: str) -> Image:
    """A line plot (160, 320, 3) of ``values`` in [0, top], with a dashed target."""
    height, width = _PLOT
    canvas = np.full((height, width, 3), _BACKGROUND, np.uint8)
    low, high, margin = height - 12, 24, 8

    def row(value: float) -> float:
        return low - (low - high) * min(value / top, 1.0)

    cv2.line(canvas, (margin, low), (width - margin, low), (0, 0, 0), 1)
    if target is not None:
        y = round(row(target))
        for x in range(margin, width - margin, 10):
            cv2.line(canvas, (x, y), (x + 5, y), _TARGET_COLOR, 1)
    columns = np.linspace(margin, width - margin, max(2, len(values)))[: len(values)]
    rows = np.array([row(float(value)) for value in values])
    line = np.rint(np.stack([columns, rows], axis=1)).astype(np.int32)
    cv2.polylines(canvas, [line], False, _ESTIMATE_COLOR, 1, cv2.LINE_AA)
    return _caption(canvas, f"{title} {values[-1]:.4f}, axis to {top:.3g}", dark=True)


def _caption(image: Any, text: str, dark: bool = False) -> Image:
    """Write one line on ``image`` in place and return it."""
    y = 14
    if not dark:
        image[: y + 6] = image[: y + 6] // 3
    color = (20, 20, 20) if dark else (255, 255, 255)
    cv2.putText(image, text, (6, y), _FONT, 0.42, color, 1, cv2.LINE_AA)
    return image
