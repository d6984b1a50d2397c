"""Parameters of the sparse SLAM."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import Checked, bounded
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M


@dataclass(frozen=True)
class SparseConfig(Checked):
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
    """

    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    features: int = bounded(600, 50, 10_000)
    levels: int = bounded(4, 1, 12)
    fast_threshold: int = bounded(7, 1, 100)
    detection_width: int = bounded(320, 1, 4000)
    hamming: int = bounded(60, 1, 256)
    pixel_noise: float = bounded(0.7, 0.01, 10.0)
    inverse_depth_noise: float = bounded(0.004, 0.0001, 1.0)
    least_matches: int = bounded(15, 6, 1000)
    least_overlap: float = bounded(0.3, 0.0, 1.0)
    least_inliers: float = bounded(0.75, 0.0, 1.0)
    least_alike: float = bounded(0.8, 0.0, 1.0)
    keyframe_m: float = bounded(0.1, 0.0, 10.0)
    keyframe_deg: float = bounded(8.0, 0.0, 90.0)
    enough_matches: int = bounded(60, 0, 10_000)
    window: int = bounded(5, 2, 100)
    loop_gap: int = bounded(10, 1, 10_000)
    loops: bool = True
    remap_m: float = bounded(0.005, 0.0, 1.0)
    remap_deg: float = bounded(0.3, 0.0, 90.0)
    max_surfels: int | None = bounded(None, 1000, 50_000_000)
