"""Registration of colour images to the depth camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera.intrinsics import Intrinsics
from ms_slam_env.config import Checked, bounded


@dataclass(frozen=True)
class Registration(Checked):
    """Pose of the colour camera relative to the depth camera, with parallel axes.

    The defaults are those commonly used for an uncalibrated Kinect, as in 7-Scenes: focal length
    525 px for colour (OpenNI's default) and 585 px for depth (the dataset's page), colour camera
    2.5 cm to the right of the depth camera.

    Attributes:
        focal_ratio: focal length of the colour camera over that of the depth camera.
        baseline_m: position of the colour camera along the depth camera's x.
        shift_x_px: pixels by which the colour image is too far to the right, at the size on disk.
        shift_y_px: pixels by which it is too far down, at the size on disk.
    """

    focal_ratio: float = bounded(525.0 / 585.0, 0.1, 10.0)
    baseline_m: float = bounded(0.025, -1.0, 1.0)
    shift_x_px: float = bounded(0.0, -1e4, 1e4)
    shift_y_px: float = bounded(0.0, -1e4, 1e4)

    def register(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        intrinsics: Intrinsics,
        factor: float = 1.0,
    ) -> NDArray[np.uint8]:
        """Resample the colour image (H, W, 3) to the depth camera's view.

        Every pixel takes the colour at its point's projection in the colour camera. A pixel without
        depth uses that of the nearest reading; without any reading the cameras' offset is
        neglected. Points outside the colour image take the colour of its border; occluded points
        take the colour of what occludes them.

        Args:
            color: (H, W, 3) as recorded.
            depth: (H, W) metres, 0 = no reading.
            intrinsics: intrinsics of the depth camera, at the size of the images.
            factor: ratio of this size to the size on disk.
        """
        K = intrinsics
        v, u = np.mgrid[: K.height, : K.width].astype(np.float32)
        parallax = self.focal_ratio * K.fx * self.baseline_m * _inverse_depth(depth)
        x = self.focal_ratio * (u - K.cx) + K.cx + factor * self.shift_x_px - parallax
        y = self.focal_ratio * (v - K.cy) + K.cy + factor * self.shift_y_px
        registered = cv2.remap(
            color,
            x.astype(np.float32),
            y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return registered.astype(np.uint8, copy=False)

    def __str__(self) -> str:
        """Describe the assumptions, for a report."""
        return (
            f"colour brought into the depth camera: focal ratio {self.focal_ratio:.4g}, baseline "
            f"{100 * self.baseline_m:g} cm, shift {self.shift_x_px:g}, {self.shift_y_px:g} px"
        )


@dataclass(frozen=True, eq=False)
class ColorCamera:
    """A calibrated colour camera with known pose relative to the depth camera.

    Attributes:
        intrinsics: intrinsics of its images on disk.
        T_color_depth: (4, 4) maps points from the depth camera's frame into its own.
    """

    intrinsics: Intrinsics
    T_color_depth: NDArray[np.float64]

    def __eq__(self, other: object) -> bool:
        """Whether both have the same values."""
        return isinstance(other, ColorCamera) and self._key == other._key

    def __hash__(self) -> int:
        """Hash of the values."""
        return hash(self._key)

    @property
    def _key(self) -> tuple[Intrinsics, bytes]:
        return self.intrinsics, self.T_color_depth.tobytes()

    def register(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32], camera: Intrinsics
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Resample the colour image (H, W, 3) to the depth camera's view; see `Registration`.

        Also return a mask (H, W) of the pixels that the colour camera sees.

        Args:
            color: as recorded, of the size of ``intrinsics``.
            depth: (H, W) metres, 0 = no reading.
            camera: intrinsics of the depth camera.
        """
        R, t = self.T_color_depth[:3, :3], self.T_color_depth[:3, 3]
        points = _rays(camera) @ R.T + _inverse_depth(depth)[..., None] * t
        is_ahead = points[..., 2] > 1e-6
        places = self.intrinsics.project(np.where(is_ahead[..., None], points, (0, 0, 1)))
        x, y = np.where(is_ahead, np.moveaxis(places, -1, 0), -1).astype(np.float32)
        registered = cv2.remap(color, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        K = self.intrinsics
        is_seen = (np.abs(2 * x - K.width + 1) <= K.width) & (
            np.abs(2 * y - K.height + 1) <= K.height
        )
        return registered.astype(np.uint8, copy=False), is_seen & is_ahead

    def __str__(self) -> str:
        """Describe the assumptions, for a report."""
        place = ", ".join(f"{100 * v:.4g}" for v in self.T_color_depth[:3, 3])
        turn = np.degrees(np.linalg.norm(cv2.Rodrigues(self.T_color_depth[:3, :3])[0]))
        K = self.intrinsics
        return (
            f"colour of {K.width}x{K.height}, focal length {K.fx:.5g} px, brought into the depth "
            f"camera, which stands at {place} cm of the colour camera, turned by {turn:.3g} deg"
        )


@lru_cache(maxsize=4)
def _rays(camera: Intrinsics) -> NDArray[np.float64]:
    return camera.rays()


def _inverse_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 / depth (H, W), filled from the nearest reading; 0 without any reading."""
    is_read = depth > 0
    if not is_read.any():
        return np.zeros_like(depth)
    inverse = (1.0 / np.where(is_read, depth, 1)).astype(np.float32)
    if is_read.all():
        return inverse
    # Every pixel with a reading is a zero pixel with its own label.
    _, nearest = cv2.distanceTransformWithLabels(
        (~is_read).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    of_label[nearest[is_read]] = inverse[is_read]
    return of_label[nearest]
