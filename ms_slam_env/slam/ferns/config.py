"""Parameters of the randomised ferns."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError


@dataclass(frozen=True)
class FernConfig:
    """How frames are encoded and which of them are kept.

    Attributes:
        num_ferns: places in the image that are tested; the code of each has four bits.
        columns: width of the reduced colour image that is tested, pixels.
        blur_px: standard deviation of the Gaussian that smooths the reduced image.
        near_m: thresholds on depth are drawn between here
        far_m: and here.
        keyframe_dissimilarity: a frame is kept if it differs by more from every kept one.

    Raises:
        InputError: a value outside its range.
    """

    num_ferns: int = 500
    columns: int = 40
    blur_px: float = 1.0
    near_m: float = 0.4
    far_m: float = 3.0
    keyframe_dissimilarity: float = 0.2

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "num_ferns", 1, 100_000)
        check_range(self, "columns", 1, 10_000)
        check_range(self, "blur_px", 0.1, 20.0)
        check_range(self, "near_m", 0.0, 100.0)
        check_range(self, "far_m", 0.0, 100.0)
        check_range(self, "keyframe_dissimilarity", 0.0, 1.0)
        if self.near_m >= self.far_m:
            raise InputError(
                f"FernConfig.near_m = {self.near_m} must be below far_m = {self.far_m}"
            )
