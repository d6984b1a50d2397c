"""Parameters of the surfel SLAM and its loop closure, named as in the paper where it has them."""

from __future__ import annotations

from dataclasses import dataclass, field

from ms_slam_env.config import check_choice, check_range
from ms_slam_env.errors import InputError


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


RELOCALISATIONS = ("ferns", "local")
LOOP_CLOSURES = ("none", "deformation")


@dataclass(frozen=True)
class SurfelConfig:
    """Parameters of tracking, fusion and prediction.

    Attributes:
        depth_cutoff_m: readings beyond are ignored, [0, 10].
        icp_rgb_weight: weight w of the photometric term against the geometric one, [0, 1]: 0 is
            geometry alone, 1 photometry alone; ``normal_equations`` has the exact cost.
        confidence_threshold: observations after which a surfel is stable, [0, 12].
        iterations: Gauss-Newton iterations per pyramid level, finest first.
        max_surfels: capacity of the map, per env; None for 400,000 with images of up to 160 columns
            and in proportion to the columns beyond.
        coverage_px: a reading starts a new surfel only where none of its surface projects this
            close to its pixel.
        surfel_radius_px: radius of a new surfel in pixels of the view that made it.
        max_confidence: where the confidence of a surfel, the weight of its past, stops growing.
        compaction_interval: frames between two removals of unstable surfels.
        unstable_window: frames after which a surfel still below the confidence threshold and
            not seen again is removed.
        fusion_distance_m: largest distance along the ray between a reading and the surfel that
            it updates, at 1 m; grows with depth squared like the sensor's noise.
        fusion_angle_deg: largest angle between their normals.
        bilateral_sigma_px: width of the bilateral depth filter in the image, pixels.
        bilateral_sigma_m: width of the filter in depth at 1 m; grows with depth squared.
        bilateral_radius_px: half-size of the filter's window, pixels.
        normal_edge_per_m: a jump of inverse depth between neighbours (of a 160-column image)
            beyond which there is an edge and no normal, 1/m.
        icp_distance_m: largest distance between associated points in tracking.
        icp_angle_deg: largest angle between their normals.
        depth_noise_m: axial noise of depth at 1 m, grows with depth squared; the unit of
            geometric residuals.
        cauchy_icp: scale of Cauchy's loss on geometric residuals, in units of that noise.
        cauchy_rgb: the same for photometric residuals.
        intensity_noise: standard deviation of a grey value, grey levels.
        lateral_noise_px: standard deviation of the place at which it was sampled, pixels.
        points_per_level: the last iteration of tracking looks at about this many pixels; the
            others at three tenths of that.
        refuse_bad_fits: whether a frame that fits the map badly counts as lost and stays out of the
            map. If not, every frame is fused at the pose that alignment found, as in ElasticFusion
            without relocalisation, and a map may show things twice.
        loop_closure: "none": frames are aligned with all of the map, however old; "deformation":
            with its recent part, and where that meets the old part again the map is bent to fit.
        loops: parameters of the latter.
        relocalisation: where a lost frame is searched besides around the last good pose: "ferns",
            at keyframes that resemble it, or "local", nowhere.

    Raises:
        InputError: a value outside its range.
    """

    depth_cutoff_m: float = 4.0
    icp_rgb_weight: float = 0.1
    confidence_threshold: float = 10.0
    iterations: tuple[int, ...] = (4, 5, 10)
    max_surfels: int | None = None
    coverage_px: float = 0.85
    surfel_radius_px: float = 0.9
    max_confidence: float = 50.0
    compaction_interval: int = 10
    unstable_window: int = 200
    fusion_distance_m: float = 0.02
    fusion_angle_deg: float = 45.0
    bilateral_sigma_px: float = 1.5
    bilateral_sigma_m: float = 0.01
    bilateral_radius_px: int = 2
    normal_edge_per_m: float = 0.03
    icp_distance_m: float = 0.10
    icp_angle_deg: float = 40.0
    depth_noise_m: float = 0.003
    cauchy_icp: float = 2.0
    cauchy_rgb: float = 1.0
    intensity_noise: float = 0.5
    lateral_noise_px: float = 0.3
    points_per_level: int = 5000
    refuse_bad_fits: bool = True
    relocalisation: str = "ferns"
    loop_closure: str = "none"
    loops: LoopConfig = field(default_factory=LoopConfig)

    def __post_init__(self) -> None:
        """Refuse values outside the ranges."""
        check_range(self, "depth_cutoff_m", 0.0, 10.0)
        check_choice(self, "relocalisation", RELOCALISATIONS)
        check_range(self, "icp_rgb_weight", 0.0, 1.0)
        check_range(self, "confidence_threshold", 0.0, 12.0)
        are_counts = isinstance(self.iterations, (tuple, list)) and all(
            isinstance(count, int) and 0 <= count <= 100 for count in self.iterations
        )
        if not are_counts or not 1 <= len(self.iterations) <= 5:
            raise InputError(
                f"SurfelConfig.iterations = {self.iterations!r} must be 1 to 5 integers in [0, 100]"
            )
        object.__setattr__(self, "iterations", tuple(self.iterations))  # lists come from YAML
        if self.max_surfels is not None:
            check_range(self, "max_surfels", 1000, 50_000_000)
        check_range(self, "coverage_px", 0.5, 1.0)
        check_range(self, "surfel_radius_px", 0.5, 3.0)
        check_range(self, "max_confidence", 1.0, 10_000.0)
        check_range(self, "compaction_interval", 1, 10_000)
        check_range(self, "unstable_window", 1, 100_000)
        check_range(self, "fusion_distance_m", 0.0001, 1.0)
        check_range(self, "fusion_angle_deg", 1.0, 90.0)
        check_range(self, "bilateral_sigma_px", 0.1, 20.0)
        check_range(self, "bilateral_sigma_m", 0.0001, 1.0)
        check_range(self, "bilateral_radius_px", 0, 10)
        check_range(self, "normal_edge_per_m", 0.001, 10.0)
        check_range(self, "icp_distance_m", 0.001, 1.0)
        check_range(self, "icp_angle_deg", 1.0, 90.0)
        check_range(self, "depth_noise_m", 0.00001, 1.0)
        check_range(self, "cauchy_icp", 0.01, 1000.0)
        check_range(self, "cauchy_rgb", 0.01, 1000.0)
        check_range(self, "intensity_noise", 0.01, 255.0)
        check_range(self, "lateral_noise_px", 0.0, 100.0)
        check_range(self, "points_per_level", 100, 10_000_000)
        if not isinstance(self.refuse_bad_fits, bool):
            raise InputError(
                f"SurfelConfig.refuse_bad_fits = {self.refuse_bad_fits!r} must be true or false"
            )
        check_choice(self, "loop_closure", LOOP_CLOSURES)

    def capacity(self, columns: int) -> int:
        """Surfels that the map of a camera with images of so many columns has room for."""
        if self.max_surfels is not None:
            return self.max_surfels
        return round(400_000 * max(1.0, columns / 160))
