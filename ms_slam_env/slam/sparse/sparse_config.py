"""Parameters of the sparse SLAM."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import Checked, bounded
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M

HAMMING = 60  # largest distance of matching descriptors, bits of 256
PIXEL_NOISE = 0.7  # standard deviation of a corner's position, pixels
INVERSE_DEPTH_NOISE = 0.004
"""Standard deviation of the inverse of a corner's depth, 1/m.

Constant for structured light, so that the depth error grows with depth squared.
"""
LEAST_MATCHES = 15  # that a pose must explain to be accepted


@dataclass(frozen=True)
class SparseConfig(Checked):
    """Parameters of features, tracking, keyframes and optimisation.

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        features: most ORB features per frame.
        levels: levels of ORB's image pyramid, each 1.2 times smaller than the one before.
        window: number of keyframes that local bundle adjustment moves.
        loops: whether to close loops.
        max_surfels: capacity of the dense map; None as in ``SurfelConfig``.
    """

    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    features: int = bounded(600, 50, 10_000)
    levels: int = bounded(4, 1, 12)
    window: int = bounded(5, 2, 100)
    loops: bool = True
    max_surfels: int | None = bounded(None, 1000, 50_000_000)
