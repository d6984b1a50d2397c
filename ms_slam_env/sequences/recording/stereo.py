"""Depth of two cameras: rectified, then matched by OpenCV's semi-global block matching.

Depth is thus an estimate of this package, not a reading of the recording: it has holes where there
is no texture, at the left border and behind edges, and its error grows with the square of depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, intensity_image
from ms_slam_env.camera.image_files import read_color
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import Float64, check_pose
from ms_slam_env.sequences.recording.recording import Entry

_BLOCK_PX = 5
_WIDEST = 1 / 6  # largest disparity over the width of the image, and so the nearest depth
_NARROWEST_PX = 64
_STEPS = 16.0  # of OpenCV's disparities, a pixel


class StereoRig:
    """A left and a right camera, rectified to the left one's intrinsics without its lens.

    Attributes:
        intrinsics: of the rectified images.
        baseline_m: distance of the cameras.
        R_left_rectified: (3, 3) rotation of the rectified camera in the left one's frame.
    """

    def __init__(self, left: Intrinsics, right: Intrinsics, T_left_right: Float64) -> None:
        """Rectify cameras of which ``T_left_right`` (4, 4) is the pose of the right one.

        The rectified x runs along the baseline, z as near the two optical axes as that allows
        (Hartley and Zisserman, section 11.12).

        Raises:
            InputError: images of different size or too narrow, or a right camera that is not to the
                right or looks elsewhere.
        """
        if left.shape != right.shape:
            raise InputError(f"the two cameras have images of {left.shape} and {right.shape}")
        if left.width < _NARROWEST_PX:
            raise InputError(
                f"stereo matching needs images of {_NARROWEST_PX} columns, got {left.width}"
            )
        check_pose(T_left_right, "pose of the right camera")
        self.baseline_m = float(np.linalg.norm(T_left_right[:3, 3]))
        if not T_left_right[0, 3] > 0.5 * self.baseline_m > 0:
            raise InputError(
                "the right camera must stand to the right of the left one, got "
                f"{np.round(T_left_right[:3, 3], 6).tolist()} m in the left camera's frame"
            )
        self.cameras = left, right
        self.intrinsics = left.undistorted
        x = T_left_right[:3, 3] / self.baseline_m
        z = np.array([0.0, 0.0, 1.0]) + T_left_right[:3, 2]
        y = np.cross(z, x)
        if not np.linalg.norm(y) > 0.5:
            raise InputError("the two cameras do not look the same way")
        y /= np.linalg.norm(y)
        self.R_left_rectified = np.stack([x, y, np.cross(x, y)], axis=1)
        rotations = self.R_left_rectified, T_left_right[:3, :3].T @ self.R_left_rectified
        self._maps = [self._map(*one) for one in zip(self.cameras, rotations, strict=True)]

    def _map(self, camera: Intrinsics, R: Float64) -> NDArray[np.float32]:
        """Column and row (2, H, W) in a camera's image of every pixel of the rectified one.

        What is beyond 90 degrees of the camera's axis is beyond its image.
        """
        rays = self.intrinsics.rays() @ R.T
        ahead = rays[..., 2] > 1e-3
        places = np.full((*rays.shape[:2], 2), -10.0)
        places[ahead] = camera.project(rays[ahead])
        return np.ascontiguousarray(np.moveaxis(places, -1, 0).astype(np.float32))

    def rectify(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Both images (H, W, 3) with corresponding points in the same row; black beyond them."""
        pairs = zip((left, right), self._maps, strict=True)
        one, other = (cv2.remap(image, x, y, cv2.INTER_LINEAR) for image, (x, y) in pairs)
        return one.astype(np.uint8, copy=False), other.astype(np.uint8, copy=False)

    def depth(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth (H, W) in metres of the rectified left image (H, W, 3); 0 where nothing matches."""
        matcher = _matcher(self.intrinsics.width)
        disparity = matcher.compute(intensity_image(left), intensity_image(right)) / _STEPS
        found = disparity > 0
        metres = self.intrinsics.fx * self.baseline_m / np.where(found, disparity, 1)
        return np.where(found, metres, 0).astype(np.float32)


def _matcher(width: int) -> cv2.StereoSGBM:
    """OpenCV's matcher with the smoothness that its documentation recommends."""
    area = _BLOCK_PX**2
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=16 * math.ceil(_WIDEST * width / 16),
        blockSize=_BLOCK_PX,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


@dataclass(frozen=True)
class StereoEntry(Entry):
    """A frame of two images; ``color`` and ``depth`` are both the left one.

    Attributes:
        right: path of the right image.
        rig: the cameras.
    """

    right: Path
    rig: StereoRig

    def read(self, camera: Intrinsics) -> tuple[NDArray[np.uint8] | None, NDArray[Any]]:
        """The rectified left image, and depth in metres; see the base class."""
        paths = zip((self.depth, self.right), self.rig.cameras, strict=True)
        left, right = self.rig.rectify(*(read_color(path, K) for path, K in paths))
        return left, self.rig.depth(left, right)
