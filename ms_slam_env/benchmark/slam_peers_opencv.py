"""OpenCV's RGB-D odometry with keyframes, as a peer of the SLAM backends."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.geometry import relative_angle

Float64 = NDArray[np.float64]


class OpenCVOdometry:
    """``cv2.Odometry`` (RGB and depth) against a keyframe; tracking only, no map.

    The keyframe is renewed when the camera has moved ``keyframe_m`` or ``keyframe_deg`` from it;
    a frame that cannot be aligned with the keyframe is tried against the frame before it.
    """

    name = "opencv"

    def __init__(
        self,
        intrinsics: Intrinsics,
        keyframe_m: float = 0.04,
        keyframe_deg: float = 3.0,
        max_depth_m: float = 4.0,
    ) -> None:
        """Set the camera and the largest depth used; all else is OpenCV's default."""
        settings = cv2.OdometrySettings()
        matrix = np.eye(3, dtype=np.float32)
        matrix[0, 0], matrix[1, 1] = intrinsics.fx, intrinsics.fy
        matrix[0, 2], matrix[1, 2] = intrinsics.cx, intrinsics.cy
        settings.setCameraMatrix(matrix)
        settings.setMaxDepth(max_depth_m)
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )
        self._keyframe_m = keyframe_m
        self._keyframe_rad = np.radians(keyframe_deg)
        self.settings = (
            f"cv2.Odometry {cv2.__version__}, RGB_DEPTH, COMMON, defaults, depth up to "
            f"{max_depth_m:g} m, keyframe every {keyframe_m:g} m or {keyframe_deg:g} degrees"
        )

    def reset(self, T_world_camera: Float64) -> None:
        """Start at a pose (4, 4)."""
        self._T_world_key = np.array(T_world_camera, dtype=np.float64)
        self._T_key_camera = np.eye(4)
        self._key: cv2.OdometryFrame | None = None
        self._last: cv2.OdometryFrame | None = None

    def track(self, frame: RGBDFrame) -> Float64:
        """Estimated T_world_camera (4, 4) of a frame."""
        depth = np.where(frame.depth > 0, frame.depth, np.float32(np.nan))
        current = cv2.OdometryFrame(depth, intensity_image(frame.color))
        self._odometry.prepareFrame(current)
        if self._key is None or self._last is None:
            self._key = self._last = current
            return self._T_world_key
        before = self._T_key_camera
        found, T_key_camera = self._align(current, self._key)
        if not found:
            found, T_last_camera = self._align(current, self._last)
            T_key_camera = before @ T_last_camera if found else before
        self._T_key_camera = T_key_camera
        T_world_camera = self._T_world_key @ T_key_camera
        moved = float(np.linalg.norm(T_key_camera[:3, 3]))
        turned = relative_angle(np.eye(3), T_key_camera[:3, :3])
        if not found or moved > self._keyframe_m or turned > self._keyframe_rad:
            self._key = current
            self._T_world_key, self._T_key_camera = T_world_camera, np.eye(4)
        self._last = current
        return T_world_camera

    def _align(
        self, current: cv2.OdometryFrame, reference: cv2.OdometryFrame
    ) -> tuple[bool, Float64]:
        """T_reference_current (4, 4), and whether it was found."""
        # OpenCV 5 ignores an initial guess: the results with and without one are the same.
        found, T = self._odometry.compute(current, reference)
        if not found or T is None or not np.isfinite(T).all():
            return False, np.eye(4)
        return True, np.asarray(T, dtype=np.float64)
