"""Compose one picture of the episode's current state."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from ms_slam_env._runtime.arrays import Float64, Image
from ms_slam_env.env.env_config import TargetConfig
from ms_slam_env.env.episode import Episode
from ms_slam_env.env.point_renderer import BACKGROUND
from ms_slam_env.env.third_person_view import ESTIMATE_COLOR, draw_third_person
from ms_slam_env.robot import Embodiment, describe
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.slam.slam_backend import SlamBackend

PANEL = (240, 320)
"""Height and width of the live images."""
_MAP = 480
_PLOT = (160, 320)
_DARK = (20, 20, 20)
_TARGET_COLOR = (90, 90, 90)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_DEPTH_M = 5.0
_ERROR_AXIS_M = 0.01
_DIVERGENCE_AXIS = 2.0  # the plots reach to this many times M, or to the largest value


def draw_moment(
    episode: Episode,
    targets: TargetConfig,
    slam: SlamBackend,
    embodiment: Embodiment,
    scene: Scene,
) -> Image:
    """Draw colour, depth, the map from outside, divergences against targets, and error so far.

    Returns:
        The picture (480, 1120, 3) uint8.
    """
    third_person, count = draw_third_person(episode, slam, embodiment, scene, _MAP)
    caption(third_person, f"map: {count} points; path: true wide green, estimated thin red")
    left = np.vstack([draw_color(episode, scene), draw_depth(episode)])
    return np.hstack([left, third_person, np.vstack(_plots(episode, targets))])


def draw_color(episode: Episode, scene: Scene) -> Image:
    """The camera's colour image, (240, 320, 3), captioned with the last motion."""
    image = cv2.resize(episode.last_frame.color, PANEL[::-1])
    motions = len(episode.step_divergences) - 1
    motion = f"motion {motions}: {describe(episode.action)}" if motions else "start"
    state = "" if episode.tracking_ok else ", TRACKING LOST"
    return caption(image, f"{scene.name}, {motion}{state}")


def draw_depth(episode: Episode) -> Image:
    """The depth image in false colours, (240, 320, 3)."""
    depth = episode.last_frame.depth
    grey = (255 * (1 - np.clip(depth / _MAX_DEPTH_M, 0, 1))).astype(np.uint8)
    colored = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    colored[depth == 0] = 0
    image = cv2.resize(colored, PANEL[::-1], interpolation=cv2.INTER_NEAREST)
    return caption(image, f"depth, 0 to {_MAX_DEPTH_M:g} m, black: no reading")


def _plots(episode: Episode, targets: TargetConfig) -> list[Image]:
    plots = []
    for k, name in enumerate(("intensity", "depth")):
        values = episode.step_divergences[:, k]
        top = max(_DIVERGENCE_AXIS * targets.maxima[k], values.max())
        target = targets.divergence[k]
        plots.append(_plot(values, target, top, f"{name} divergence", "motions"))
    errors = episode.pose_errors
    top = max(_ERROR_AXIS_M, errors.max())
    return [*plots, _plot(errors, None, top, "pose error [m]", "frames")]


def _plot(values: Float64, target: float | None, top: float, title: str, unit: str) -> Image:
    """A line plot (160, 320, 3) of ``values`` in [0, top], from the start.

    A target is a dashed line, labelled beside the title.
    """
    height, width = _PLOT
    canvas = np.full((height, width, 3), BACKGROUND, np.uint8)
    low, high, margin = height - 18, 34, 8

    def row(value: float) -> float:
        return low - (low - high) * value / top

    cv2.line(canvas, (margin, low), (width - margin, low), (0, 0, 0), 1)
    cv2.line(canvas, (margin, high), (margin, low), (0, 0, 0), 1)
    _write(canvas, f"{top:.2g}", (margin + 4, high + 4), 0.34)
    ends = f"{len(values) - 1} {unit}"
    _write(canvas, ends, (width - margin - 6 * len(ends), height - 5), 0.34)
    if target is not None:
        _dash(canvas, margin, width - margin, round(row(target)))
        _dash(canvas, width - 112, width - 86, 10)
        _write(canvas, f"target {target:.4f}", (width - 82, 14), 0.36)
    columns = np.linspace(margin, width - margin, max(2, len(values)))[: len(values)]
    rows = np.array([row(float(value)) for value in values])
    line = np.rint(np.stack([columns, rows], axis=1)).astype(np.int32)
    cv2.polylines(canvas, [line], False, ESTIMATE_COLOR, 1, cv2.LINE_AA)
    _write(canvas, f"{title} {values[-1]:.4f}", (6, 14), 0.42)
    return canvas


def _dash(image: Image, left: int, right: int, y: int) -> None:
    for x in range(left, right, 10):
        cv2.line(image, (x, y), (min(x + 5, right), y), _TARGET_COLOR, 1)


def caption(image: Any, text: str) -> Image:
    """Write one line on the darkened top of ``image`` in place and return it."""
    image[:20] = image[:20] // 3
    cv2.putText(image, text, (6, 14), _FONT, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def _write(image: Image, text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(image, text, at, _FONT, size, _DARK, 1, cv2.LINE_AA)
