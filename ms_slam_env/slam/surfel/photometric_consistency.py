"""How like a frame is the map's view from the pose where it is believed to be.

The tracker explains a frame with a gain and a bias of its own, and self-similar textures fit
themselves at many places about as well as noise permits. Here the two images are laid upon each
other once more, pixel by pixel, without that freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.slam.base import Float32

_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601
_WINDOW = 11  # pixels of the view; variations over longer distances are shading, not texture
_SMOOTHING = 3
_FEWEST_PIXELS = 100


@dataclass(frozen=True)
class Likeness:
    """A frame beside a view.

    Attributes:
        overlap: share of the frame's readings where the view shows something.
        inliers: share of those with the view's depth, to 2 cm + 2 cm/m^2.
        correlation: normalised, of the fine structure of both grey images there.
        texture: standard deviation of their fine structure, of the image that has more, grey
            levels.
        relief_m: RMS distance of the view's surface from the plane that fits it best.
    """

    overlap: float
    inliers: float
    correlation: float
    texture: float
    relief_m: float


@dataclass(frozen=True)
class LikenessLimits:
    """What a frame has in common with the view from its true pose.

    In six scenes at 160x120 the correlation was at least 0.88 at true poses, but for a map that had
    drifted; with a rolling shutter, blur, misregistered colour, changing exposure and patches
    without depth, all at once, it was 0.5 or more at three of four. At poses that the tracker had
    come to, 10 cm or 10 degrees off or in another scene, it was below 0.35 but for two of 307.

    Attributes:
        overlap: least share of the frame that the view shows.
        inliers: least share of it with the view's depth.
        correlation: least correlation.
        texture: with less there is nothing to correlate, and depth alone must tell the place:
        inliers_alone: by so large a share with the view's depth
        relief_m: and a surface with so much relief; planes look alike.
    """

    overlap: float = 0.4
    inliers: float = 0.85
    correlation: float = 0.45
    texture: float = 2.0
    inliers_alone: float = 0.95
    relief_m: float = 0.05

    def accept(self, likeness: Likeness) -> bool:
        """Whether frame and view show the same."""
        if likeness.overlap < self.overlap or likeness.inliers < self.inliers:
            return False
        if likeness.texture < self.texture:
            return likeness.inliers >= self.inliers_alone and likeness.relief_m >= self.relief_m
        return likeness.correlation >= self.correlation


def measure_likeness(
    color: NDArray[np.uint8],
    depth: Float32,
    view_intensity: Float32,
    view_depth: Float32,
    cutoff_m: float,
) -> Likeness:
    """Compare a frame with the map's view from the same pose.

    Args:
        color: (H, W, 3).
        depth: (H, W) metres; 0 = no reading.
        view_intensity: (h, w) every n-th row and column of the camera's image.
        view_depth: (h, w) metres; 0 where the map is empty.
        cutoff_m: readings beyond are no part of the map.
    """
    step = -(-depth.shape[0] // view_depth.shape[0])
    sensed = depth[::step, ::step]
    reading = (sensed > 0) & (sensed <= cutoff_m)
    both = reading & (view_depth > 0)
    if both.sum() < _FEWEST_PIXELS:
        return Likeness(0.0, 0.0, 0.0, 0.0, 0.0)
    grey = color[::step, ::step].astype(np.float32) @ _LUMA
    tolerance = 0.02 + 0.02 * sensed[both] ** 2
    one, other = _fine_structure(grey, both), _fine_structure(view_intensity, both)
    norms = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return Likeness(
        overlap=float(both.sum() / reading.sum()),
        inliers=float((np.abs(view_depth - sensed)[both] <= tolerance).mean()),
        correlation=float((one * other).sum()) / norms if norms > 0 else 0.0,
        texture=float(np.sqrt(max((one[both] ** 2).mean(), (other[both] ** 2).mean()))),
        relief_m=_relief(view_depth, both),
    )


def _relief(depth: Float32, where: NDArray[np.bool_]) -> float:
    """RMS distance in metres, along the rays, from the plane that fits the depth best.

    The inverse depth of a plane is linear in the image.
    """
    v, u = np.nonzero(where)
    inverse = 1.0 / depth[where].astype(np.float64)
    places = np.stack([u, v, np.ones_like(u)], axis=1).astype(np.float64)
    plane = np.linalg.lstsq(places, inverse, rcond=None)[0]
    residual = (inverse - places @ plane) / inverse**2
    return float(np.sqrt((residual**2).mean()))


def _fine_structure(image: Float32, where: NDArray[np.bool_]) -> Float32:
    """Image less its local mean, slightly smoothed; 0 outside ``where``."""
    weight = where.astype(np.float32)
    window = (_WINDOW, _WINDOW)
    local = cv2.blur(image * weight, window) / np.maximum(cv2.blur(weight, window), 1e-6)
    detail = np.where(where, image - local, 0).astype(np.float32)
    return cv2.blur(detail, (_SMOOTHING, _SMOOTHING)) * weight
