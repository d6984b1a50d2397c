"""Colour brought into the depth camera."""

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
    """Where the colour camera is, as seen from the depth camera; the axes of both are parallel.

    The defaults are those commonly given for a Kinect that nobody calibrated, as in 7-Scenes:
    focal length 525 px for colour (OpenNI's default) and 585 px for depth (the dataset's page),
    colour 2.5 cm to the right of depth.

    Attributes:
        focal_ratio: focal length of the colour camera over that of the depth camera.
        baseline_m: the colour camera stands so far along the depth camera's x.
        shift_x_px: the colour image lies so many pixels too far to the right, at the size on disk.
        shift_y_px: and so many too far down.
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
        """Colour image (H, W, 3) as the depth camera would see it.

        Every pixel takes the colour at the place where its point lies in the colour camera. A pixel
        without depth borrows that of the nearest reading; where there is none at all the offset
        of the cameras is neglected. What the colour camera does not see takes the colour of the
        image's border; what is hidden from it takes the colour of what hides it.

        Args:
            color: (H, W, 3) as recorded.
            depth: (H, W) metres, 0 = no reading.
            intrinsics: of the depth camera, at the size of the images.
            factor: this size over the size on disk.
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
        """Return what is assumed, for a report."""
        return (
            f"colour brought into the depth camera: focal ratio {self.focal_ratio:.4g}, baseline "
            f"{100 * self.baseline_m:g} cm, shift {self.shift_x_px:g}, {self.shift_y_px:g} px"
        )


@dataclass(frozen=True, eq=False)
class ColorCamera:
    """A colour camera that is calibrated and whose place beside the depth camera is known.

    Attributes:
        intrinsics: of its images on disk.
        T_color_depth: (4, 4) maps points of the depth camera into its frame.
    """

    intrinsics: Intrinsics
    T_color_depth: NDArray[np.float64]

    def __eq__(self, other: object) -> bool:
        """Whether both say the same."""
        return isinstance(other, ColorCamera) and self._key == other._key

    def __hash__(self) -> int:
        """Of what it says."""
        return hash(self._key)

    @property
    def _key(self) -> tuple[Intrinsics, bytes]:
        return self.intrinsics, self.T_color_depth.tobytes()

    def register(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32], camera: Intrinsics
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colour image (H, W, 3) as the depth camera would see it, as `Registration.register` does.

        And (H, W) whether the colour camera sees what a pixel shows.

        Args:
            color: as recorded, of the size that ``intrinsics`` say.
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
        """Return what is assumed, for a report."""
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
    """1 / depth (H, W), of the nearest reading where there is none; 0 without any reading."""
    is_read = depth > 0
    if not is_read.any():
        return np.zeros_like(depth)
    inverse = (1.0 / np.where(is_read, depth, 1)).astype(np.float32)
    if is_read.all():
        return inverse
    # Every pixel with a reading is a zero pixel with a label of its own.
    _, nearest = cv2.distanceTransformWithLabels(
        (~is_read).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, dtype=np.float32)
    of_label[nearest[is_read]] = inverse[is_read]
    return of_label[nearest]
