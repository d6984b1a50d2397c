"""Aligning a frame with a view of the model: the interface of its two variants."""

from __future__ import annotations

from abc import ABC, abstractmethod

from ms_slam_env.slam.alignment_check import DepthImage
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.volumetric.voxel_grid import CastView


class FrameToModel(ABC):
    """Finds the motion between the model's view and a frame."""

    @abstractmethod
    def align(self, frame: DepthImage, view: CastView) -> Float64 | None:
        """T_model_camera (4, 4) of a frame, searched from rest; None if there is none."""
