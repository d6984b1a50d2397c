"""Parameters of loop closure."""

from __future__ import annotations

from dataclasses import dataclass

from ms_slam_env.config import check_range


@dataclass(frozen=True)
class LoopConfig:
    """When loops are looked for, when they are believed, and how the map is bent.

    ElasticFusion's published values are for 640x480 at 30 Hz and minutes of recording; these are
    shares of the image and of the map where they can be, and frames elsewhere.

    Attributes:
        window: frames for which a surfel that is not seen stays active.
        interval: frames between two looks for a loop.
        coverage: share of the image that the inactive part of the map must cover.
        sigma: largest standard deviation (metres, radians) of the worst direction of the
            registration of active and inactive part.
        inliers: least share of matched points that the registration explains.
        largest_m: largest correction of the camera's position that is believed.
        largest_deg: largest correction of its rotation.
        smallest_m: a correction that moves a point at 1 m less than this bends nothing: the
            inactive surfels are taken back as they are.
        agreement_m: a loop is closed when two looks agree so far on the correction, at 1 m.
        global_interval: frames between two looks at keyframes; a multiple of ``interval``.
        dissimilarity: of a frame and a keyframe that may show the same place, share of the ferns.
        drift_share: a keyframe's place is believed if it is no further away than this share of the
            way since.
        surfels_per_node: of the deformation graph.
        max_nodes: of the deformation graph.
        constraint_columns: the image is divided into so many columns, with rows as high as they
            are wide; each cell gives one constraint and one pin.
        error_m: largest RMS distance that the constraints may keep after the graph was optimised.
        error_share: the same as a share of the distance before.

    Raises:
        InputError: a value outside its range.
    """

    window: int = 50
    interval: int = 5
    coverage: float = 0.25
    sigma: float = 0.01
    inliers: float = 0.7
    largest_m: float = 0.3
    largest_deg: float = 20.0
    smallest_m: float = 0.008
    agreement_m: float = 0.01
    global_interval: int = 20
    dissimilarity: float = 0.3
    drift_share: float = 0.15
    surfels_per_node: int = 400
    max_nodes: int = 100
    constraint_columns: int = 16
    error_m: float = 0.01
    error_share: float = 0.3

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "window", 1, 1_000_000)
        check_range(self, "interval", 1, 10_000)
        check_range(self, "coverage", 0.01, 1.0)
        check_range(self, "sigma", 1e-6, 1.0)
        check_range(self, "inliers", 0.0, 1.0)
        check_range(self, "largest_m", 0.0, 100.0)
        check_range(self, "largest_deg", 0.0, 180.0)
        check_range(self, "smallest_m", 0.0, 1.0)
        check_range(self, "agreement_m", 0.0, 1.0)
        check_range(self, "global_interval", 1, 10_000)
        check_range(self, "dissimilarity", 0.0, 1.0)
        check_range(self, "drift_share", 0.0, 10.0)
        check_range(self, "surfels_per_node", 10, 1_000_000)
        check_range(self, "max_nodes", 10, 10_000)
        check_range(self, "constraint_columns", 2, 100)
        check_range(self, "error_m", 0.0, 1.0)
        check_range(self, "error_share", 0.0, 1.0)
