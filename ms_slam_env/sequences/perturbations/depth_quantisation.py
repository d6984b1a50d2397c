"""Depth in steps of disparity."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import check_range
from ms_slam_env.sequences.perturbations.base import ImagePerturbation, Moment

_NATIVE_WIDTH = 640


@dataclass(frozen=True)
class DepthQuantisation(ImagePerturbation):
    """Disparity d = f b / z of the 640 pixels wide sensor, rounded to whole steps.

    Source: Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 2012: baseline 7.5 cm, steps of an eighth of a pixel; the
    depth resolution step / (f b) * z^2 is their section 3.3. The sensor's noise model "kinect" has
    these steps already; this adds coarser ones, or steps to a sensor without noise.

    Attributes:
        step_px: step of the disparity in pixels; 0 = off.
        baseline_m: distance between projector and camera.

    Raises:
        InputError: a value out of range.
    """

    step_px: float = 0.25
    baseline_m: float = 0.075

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "step_px", 0.0, 8.0)
        check_range(self, "baseline_m", 1e-3, 1.0)

    def apply(self, frame: RGBDFrame, moment: Moment) -> RGBDFrame:
        """See the base class."""
        if self.step_px == 0:
            return frame
        native_fx = moment.intrinsics.fx * _NATIVE_WIDTH / moment.intrinsics.width
        unit = native_fx * self.baseline_m / self.step_px  # depth times disparity in steps
        is_read = frame.depth > 0
        steps = np.rint(unit / np.where(is_read, frame.depth, 1.0).astype(np.float64))
        depth = np.where(is_read & (steps >= 1), unit / np.maximum(steps, 1), 0.0)
        return dataclasses.replace(frame, depth=depth.astype(np.float32))
