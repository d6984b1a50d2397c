"""Parameters of the sparse SLAM."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError


@dataclass(frozen=True)
class SparseConfig:
    """Parameters of features, tracking, keyframes and optimisation.

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        features: ORB features taken from a frame at most.
        levels: levels of ORB's image pyramid, each 1.2 times smaller than the one before.
        fast_threshold: least contrast of a corner, grey levels.
        detection_width: smaller images are magnified to this width before features are sought:
            ORB describes a patch of 31 pixels, a fifth of an image of 160.
        hamming: largest distance of matching descriptors, bits of 256.
        pixel_noise: standard deviation of a corner's position, pixels.
        inverse_depth_noise: standard deviation of the inverse of its depth, 1/m. Structured light
            errs by a constant one, so that the error of depth grows with depth squared.
        least_matches: matches that a pose must explain to be believed.
        least_overlap: share of a frame's readings that the keyframe beside it must show,
        least_inliers: share of those that must fit its depth,
        least_alike: share of those that must fit its intensity.
        keyframe_m: a frame becomes a keyframe when it is this far from the others in sight,
        keyframe_deg: or turned by this much,
        enough_matches: a quarter of that where fewer matches explain its pose.
        window: keyframes that local bundle adjustment moves.
        loop_gap: keyframes between a frame and one that it may close a loop with.
        loops: whether loops are closed.
        remap_m: the dense map is made anew when a keyframe has moved by this much,
        remap_deg: or turned by this much, since it was fused.
        max_surfels: capacity of the dense map; None as in ``SurfelConfig``.

    Raises:
        InputError: a value outside its range.
    """

    depth_cutoff_m: float = 4.0
    features: int = 600
    levels: int = 4
    fast_threshold: int = 7
    detection_width: int = 320
    hamming: int = 60
    pixel_noise: float = 0.7
    inverse_depth_noise: float = 0.004
    least_matches: int = 15
    least_overlap: float = 0.3
    least_inliers: float = 0.75
    least_alike: float = 0.8
    keyframe_m: float = 0.1
    keyframe_deg: float = 8.0
    enough_matches: int = 60
    window: int = 5
    loop_gap: int = 10
    loops: bool = True
    remap_m: float = 0.005
    remap_deg: float = 0.3
    max_surfels: int | None = None

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "depth_cutoff_m", 0.1, 10.0)
        check_range(self, "features", 50, 10_000)
        check_range(self, "levels", 1, 12)
        check_range(self, "fast_threshold", 1, 100)
        check_range(self, "detection_width", 1, 4000)
        check_range(self, "hamming", 1, 256)
        check_range(self, "pixel_noise", 0.01, 10.0)
        check_range(self, "inverse_depth_noise", 0.0001, 1.0)
        check_range(self, "least_matches", 6, 1000)
        check_range(self, "least_overlap", 0.0, 1.0)
        check_range(self, "least_inliers", 0.0, 1.0)
        check_range(self, "least_alike", 0.0, 1.0)
        check_range(self, "keyframe_m", 0.0, 10.0)
        check_range(self, "keyframe_deg", 0.0, 90.0)
        check_range(self, "enough_matches", 0, 10_000)
        check_range(self, "window", 2, 100)
        check_range(self, "loop_gap", 1, 10_000)
        if not isinstance(self.loops, bool):
            raise InputError(f"SparseConfig.loops = {self.loops!r} must be true or false")
        check_range(self, "remap_m", 0.0, 1.0)
        check_range(self, "remap_deg", 0.0, 90.0)
        if self.max_surfels is not None:
            check_range(self, "max_surfels", 1000, 50_000_000)
