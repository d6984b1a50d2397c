"""Aligns two RGB-D images through OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.slam.alignment_check import DepthImage
from ms_slam_env.slam.base import Float64


@dataclass(frozen=True)
class PreparedImage:
    """An image and OpenCV's pyramids of it."""

    image: DepthImage
    pyramids: cv2.OdometryFrame


class Aligner:
    """``cv2.Odometry`` on colour and depth with OpenCV's default settings.

    Args:
        intrinsics: of both images.
        depth_cutoff_m: readings beyond are ignored.

    Raises:
        InputError: OpenCV is older than 5 and has no ``cv2.Odometry``.
    """

    def __init__(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        if int(cv2.__version__.split(".")[0]) < 5:
            raise InputError(
                "this backend needs OpenCV 5 (pip install 'opencv-python-headless>=5'), found "
                f"{cv2.__version__}"
            )
        settings = cv2.OdometrySettings()
        matrix = np.eye(3, dtype=np.float32)
        matrix[0, 0], matrix[1, 1] = intrinsics.fx, intrinsics.fy
        matrix[0, 2], matrix[1, 2] = intrinsics.cx, intrinsics.cy
        settings.setCameraMatrix(matrix)
        settings.setMaxDepth(depth_cutoff_m)
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )

    def prepare(self, image: DepthImage) -> PreparedImage:
        """Build the pyramids of an image; ``align`` takes images so prepared."""
        depth = np.where(image.depth > 0, image.depth, np.float32(np.nan))
        grey = np.clip(np.rint(image.intensity), 0, 255).astype(np.uint8)
        pyramids = cv2.OdometryFrame(depth, grey)
        self._odometry.prepareFrame(pyramids)
        return PreparedImage(image, pyramids)

    def align(self, frame: PreparedImage, reference: PreparedImage) -> Float64 | None:
        """T_reference_frame (4, 4), or None if OpenCV found none.

        The search starts at rest: OpenCV 5 ignores an initial guess.
        """
        found, T = self._odometry.compute(frame.pyramids, reference.pyramids)
        if not found or T is None or not np.isfinite(T).all():
            return None
        return np.asarray(T, dtype=np.float64)
