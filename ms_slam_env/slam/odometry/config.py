"""Parameters of the keyframe odometry."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import check_range


@dataclass(frozen=True)
class OdometryConfig:
    """Parameters of tracking and of the map of keyframes.

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        keyframe_m: the keyframe is renewed when the camera is this far from it,
        keyframe_deg: or turned by this much.
        least_overlap: share of a frame's readings that the image it is aligned with must show,
        least_inliers: share of those that must fit its depth,
        least_alike: share of those that must fit its intensity.
        max_surfels: capacity of the map; None as in ``SurfelConfig``.

    Raises:
        InputError: a value outside its range.
    """

    depth_cutoff_m: float = 4.0
    keyframe_m: float = 0.04
    keyframe_deg: float = 3.0
    least_overlap: float = 0.3
    least_inliers: float = 0.75
    least_alike: float = 0.9
    max_surfels: int | None = None

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "depth_cutoff_m", 0.1, 10.0)
        check_range(self, "keyframe_m", 0.0, 1.0)
        check_range(self, "keyframe_deg", 0.0, 90.0)
        check_range(self, "least_overlap", 0.0, 1.0)
        check_range(self, "least_inliers", 0.0, 1.0)
        check_range(self, "least_alike", 0.0, 1.0)
        if self.max_surfels is not None:
            check_range(self, "max_surfels", 1000, 50_000_000)
