"""Draw point clouds: near dots hide far ones, and gaps between dots are closed."""

from __future__ import annotations

import cv2
import numpy as np

from ms_slam_env._runtime.arrays import Float64, Image
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, transform_points

NEAREST_M = 0.1  # points nearer than this are not drawn
BACKGROUND = 250
_IN_FRONT_M = 0.03  # a dot covers dots at least this much farther, so not its own surface
_LARGEST = 4  # pixels, largest radius of a dot
_CLOSED = 5  # pixels, width of the gaps that are closed


def project(
    camera: Intrinsics, T_world_camera: Float64, points: Float64
) -> tuple[Float64, Float64]:
    """Project points (N, 3) to pixels (N, 2), -1 where not drawn, and depths (N,)."""
    local = transform_points(invert(T_world_camera), points)
    in_front = local[:, 2] > NEAREST_M
    pixels = np.full((len(local), 2), -1.0)
    pixels[in_front] = camera.project(local[in_front])
    return pixels, local[:, 2]


def render_points(
    camera: Intrinsics, T_world_camera: Float64, points: Float64, colors: Image, dots_m: Float64
) -> Image:
    """Draw points (N, 3) with colours (N, 3) as dots of diameters (N,); picture (H, W, 3)."""
    pixels, depth = project(camera, T_world_camera, points)
    u, v = np.rint(pixels).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    far_first = np.flatnonzero(inside)[np.argsort(-depth[inside], kind="stable")]
    where = v[far_first], u[far_first]
    picture = np.full((*camera.shape, 3), BACKGROUND, np.uint8)
    nearest = np.full(camera.shape, np.inf)
    radius = np.zeros(camera.shape)
    picture[where] = colors[far_first]  # the nearest is written last
    nearest[where] = depth[far_first]
    radius[where] = 0.5 * dots_m[far_first] * camera.fx / depth[far_first]
    picture, nearest = _widen(picture, nearest, np.minimum(radius, _LARGEST))
    return _close(picture, nearest)


def _widen(picture: Image, depth: Float64, radius: Float64) -> tuple[Image, Float64]:
    """Let each pixel cover neighbours that are empty or clearly behind it."""
    wide, nearest = picture.copy(), depth.copy()
    reach = int(np.ceil(radius.max(initial=0)))
    height, width = depth.shape
    steps = [(dy, dx) for dy in range(-reach, reach + 1) for dx in range(-reach, reach + 1)]
    for dy, dx in sorted(steps, key=lambda step: step[0] ** 2 + step[1] ** 2)[1:]:
        to = slice(max(0, dy), height + min(0, dy)), slice(max(0, dx), width + min(0, dx))
        of = slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx))
        covers = radius[of] >= np.hypot(dy, dx) - 0.5
        covers &= depth[of] < nearest[to] - np.where(np.isinf(nearest[to]), 0, _IN_FRONT_M)
        wide[to][covers] = picture[of][covers]
        nearest[to][covers] = depth[of][covers]
    return wide, nearest


def _close(picture: Image, depth: Float64) -> Image:
    """Fill small gaps with the colour of the nearest pixel that has one."""
    filled = np.isfinite(depth).astype(np.uint8)
    gap = cv2.morphologyEx(filled, cv2.MORPH_CLOSE, np.ones((_CLOSED, _CLOSED), np.uint8)) > filled
    if not gap.any():
        return picture
    _, label = cv2.distanceTransformWithLabels(
        1 - filled, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    color_of = np.zeros((label.max() + 1, 3), np.uint8)
    color_of[label[filled > 0]] = picture[filled > 0]
    result = picture.copy()
    result[gap] = color_of[label[gap]]
    return result
