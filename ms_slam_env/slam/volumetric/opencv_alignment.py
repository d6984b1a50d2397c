"""Aligns a frame with a view of the model through OpenCV's odometry."""

from __future__ import annotations

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.alignment_check import DepthImage
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.odometry.aligner import Aligner
from ms_slam_env.slam.volumetric.frame_to_model import FrameToModel
from ms_slam_env.slam.volumetric.voxel_grid import CastView


class OpenCVAlignment(FrameToModel):
    """OpenCV's RGB-D odometry; the same result in every run."""

    def __init__(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Set the camera and the largest depth used."""
        self._aligner = Aligner(intrinsics, depth_cutoff_m)

    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """T_model_camera (4, 4) of a frame against a view of the model, None if there is none."""
        model = self._aligner.prepare(DepthImage(view.depth, view.intensity))
        return self._aligner.align(self._aligner.prepare(frame), model)
