"""A colour camera that is not the depth camera."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ms_slam_env.config import check_range
from ms_slam_env.geometry import make_pose
from ms_slam_env.sequences.perturbations.base import OpticalPerturbation, Optics


@dataclass(frozen=True)
class Misregistration(OpticalPerturbation):
    """Colour and depth, taken by two cameras, are handed on as if they were one image.

    The frame's intrinsics and pose stay those of the depth camera. The defaults are a Kinect's
    whose driver registers nothing, as in 7-Scenes.

    Attributes:
        focal_ratio: focal length of the colour camera over that of the depth camera; 1 = equal.
        baseline_m: the colour camera stands so far along the depth camera's x; 0 = at its place.
        shift_x_px: the colour image lies so many pixels too far to the right.
        shift_y_px: and so many too far down.

    Raises:
        InputError: a value out of range.
    """

    focal_ratio: float = 525.0 / 585.0
    baseline_m: float = 0.025
    shift_x_px: float = 0.0
    shift_y_px: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "focal_ratio", 0.1, 10.0)
        check_range(self, "baseline_m", -1.0, 1.0)
        check_range(self, "shift_x_px", -1e4, 1e4)
        check_range(self, "shift_y_px", -1e4, 1e4)

    def alter(self, optics: Optics) -> Optics:
        """See the base class."""
        K = optics.color
        color = dataclasses.replace(
            K,
            fx=K.fx * self.focal_ratio,
            fy=K.fy * self.focal_ratio,
            cx=K.cx + self.shift_x_px,
            cy=K.cy + self.shift_y_px,
        )
        offset = make_pose([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [self.baseline_m, 0.0, 0.0])
        return dataclasses.replace(optics, color=color, T_depth_color=optics.T_depth_color @ offset)
