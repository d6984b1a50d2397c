"""Parameters of the surfel SLAM and its loop closure, named as in the paper where it has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.config import Checked, bounded, check_counts, chosen
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M


@dataclass(frozen=True)
class LoopConfig(Checked):
    """When loops are looked for, when they are believed, and how the map is deformed.

    ElasticFusion's published values are for 640x480 at 30 Hz and minutes of recording; these are
    shares of the image and of the map where they can be, and frames elsewhere.

    Attributes:
        window: frames for which a surfel that is not seen stays active.
        interval: frames between two looks for a loop.
        coverage: share of the image that the inactive part of the map must cover.
        largest_m: largest correction of the camera's position that is believed.
        smallest_m: a correction that moves a point at 1 m less than this deforms nothing: the
            inactive surfels are taken back as they are.
        global_interval: frames between two looks at keyframes; a multiple of ``interval``.
        drift_share: a keyframe's place is believed if it is no further away than this share of the
            way since.
    """

    window: int = bounded(50, 1, 1_000_000)
    interval: int = bounded(5, 1, 10_000)
    coverage: float = bounded(0.25, 0.01, 1.0)
    largest_m: float = bounded(0.3, 0.0, 100.0)
    smallest_m: float = bounded(0.008, 0.0, 1.0)
    global_interval: int = bounded(20, 1, 10_000)
    drift_share: float = bounded(0.15, 0.0, 10.0)


@dataclass(frozen=True)
class DoubtConfig(Checked):
    """When a frame that is refused is compared with the map's view from where it was found.

    There it is accepted, uncertain or refused for good; see
    ``alignment_check.status_on_appeal``.

    Attributes:
        inliers: least share of the matched points that are inliers.
        alike: least share of the textured points that are photometric inliers.
        conflicts: largest share of the matched points whose depth conflicts.
        cost: largest mean truncated cost of the visible points, in [0, 3].
    """

    inliers: float = bounded(0.55, 0.0, 1.0)
    alike: float = bounded(0.55, 0.0, 1.0)
    conflicts: float = bounded(0.3, 0.0, 1.0)
    cost: float = bounded(1.7, 0.0, 3.0)


@dataclass(frozen=True)
class AcceptanceConfig(Checked):
    """When a pixel counts for an alignment with the map, and when a frame's alignment is accepted.

    Attributes:
        inlier_sigmas: a matched point is an inlier if its residual is less than so many standard
            deviations of the depth noise. Chosen together with ``inliers``, as
            ``acceptance_thresholds`` says: at a right pose, Gaussian depth noise as large as
            ``depth_noise_m`` leaves all points inliers, 2.5 times as large 89 %, 4 times 68 %.
        conflict_sigmas: its depth conflicts if it is further away than this along the ray.
        texture: least intensity gradient of a textured point, grey levels per pixel (of the sum of
            both components).
        photometric_inlier: largest photometric residual of an inlier, grey levels, at the usual
            scale of residuals.
        points: fewest matched points.
        overlap: least share of the map's points in view that the live image covers.
        inliers: least share of the matched points that are inliers.
        alike: least share of the textured points that are photometric inliers.
        conflicts: largest share of the matched points whose depth conflicts.
        cost: largest mean truncated cost of the visible points, in [0, 3].
        doubted: laxer values, of frames that are looked at once more.
    """

    inlier_sigmas: float = bounded(4.0, 0.1, 100.0)
    conflict_sigmas: float = bounded(8.0, 0.1, 1000.0)
    texture: float = bounded(4.0, 0.0, 255.0)
    photometric_inlier: float = bounded(20.0, 0.1, 255.0)
    points: int = bounded(100, 6, 1_000_000)
    overlap: float = bounded(0.3, 0.0, 1.0)
    inliers: float = bounded(0.65, 0.0, 1.0)
    alike: float = bounded(0.7, 0.0, 1.0)
    conflicts: float = bounded(0.15, 0.0, 1.0)
    cost: float = bounded(1.4, 0.0, 3.0)
    doubted: DoubtConfig = field(default_factory=DoubtConfig)


@dataclass(frozen=True)
class SubmapConfig(Checked):
    """When a submap starts, how older ones are looked for, and when two are joined.

    Attributes:
        after: frames in a row that show something and are refused before a submap starts.
        fewest_keyframes: a map with fewer is forgotten when it is lost.
        interval: frames between two looks for an older submap.
        dissimilarity: of a frame and a keyframe that may show the same place, share of the ferns.
        looks: that must agree on how two submaps lie,
        step_m: from places this far apart,
        step_deg: or this far turned, unless ``interval`` frames lie between.
        agreement_m: they agree if they put the camera no further apart,
        agreement_deg: and turn it no further.
        guess_sigma_m: standard deviation of each coordinate of the pose at which a submap starts,
            as the caller guessed it,
        guess_sigma_deg: and of its rotation about each axis; larger where there is no guess.
    """

    after: int = bounded(5, 1, 1_000_000)
    fewest_keyframes: int = bounded(1, 1, 10_000)
    interval: int = bounded(5, 1, 10_000)
    dissimilarity: float = bounded(0.5, 0.0, 1.0)
    looks: int = bounded(3, 1, 100)
    step_m: float = bounded(0.05, 0.0, 10.0)
    step_deg: float = bounded(5.0, 0.0, 180.0)
    agreement_m: float = bounded(0.03, 0.0, 1.0)
    agreement_deg: float = bounded(1.5, 0.0, 180.0)
    guess_sigma_m: float = bounded(0.03, 0.0, 10.0)
    guess_sigma_deg: float = bounded(2.0, 0.0, 180.0)


COLOR_REGISTRATIONS = ("estimated", "given")
RELOCALISATIONS = ("ferns", "features", "local")
LOOP_CLOSURES = ("none", "deformation")
SUBMAPS = ("atlas", "off")
MOTION_MASKS = ("none", "geometric")


PAPER: dict[str, tuple[float, float, float]] = {
    "depth_cutoff_m": (3.0, 0.0, 10.0),
    "icp_rgb_weight": (0.1, 0.0, 1.0),
    "confidence_threshold": (10.0, 0.0, 12.0),
}
"""Parameters of ElasticFusion with default, lowest and highest value (ICRA 2017, section IV-A)."""


@dataclass(frozen=True)
class SurfelConfig(Checked):
    """Parameters of tracking, fusion and prediction.

    Attributes:
        depth_cutoff_m: readings beyond are ignored; those with more than 48 mm of noise,
            by default beyond 4 m, count the less the more noise they have.
        icp_rgb_weight: weight w of the photometric term against the geometric one, [0, 1]: 0 is
            geometry alone, 1 photometry alone; ``normal_equations`` has the exact cost.
        confidence_threshold: observations after which a surfel is stable, [0, 12].
        iterations: Gauss-Newton iterations per pyramid level, finest first.
        max_surfels: capacity of the map, per env; None for 500,000 with images of up to 160 columns
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
        points_per_level: the last iteration of tracking looks at about this many pixels; the
            others at three tenths of that.
        refuse_bad_fits: whether a frame that fits the map badly counts as lost and stays out of the
            map. If not, every frame is fused at the pose that alignment found, as in ElasticFusion
            without relocalisation, and a map may show things twice.
        acceptance: which pixels and frames fit the map.
        loop_closure: "none": frames are aligned with all of the map, however old; "deformation":
            with its recent part; where that meets the old part again the map is deformed to fit.
        loops: parameters of the latter.
        relocalisation: where a lost frame is searched besides around the last good pose: "ferns",
            at keyframes that resemble it, "features", where their ORB features put it if that leads
            nowhere, or "local", nowhere.
        submaps: "atlas": a camera whose frames stay out of the map goes on in a new one, which is
            joined to the old one where that is seen again; "off": it waits. Of several cameras in
            lockstep each waits.
        submap_rules: parameters of the former.
        motion_mask: "geometric": what moves is neither tracked nor mapped, see ``free_space_mask``;
            "none": the world is taken to be still.
        readout_s: time that a rolling shutter takes from the first row to the last, see
            ``rolling_shutter``; 0: all rows are taken at once. It takes frames with their times.
        check_slips: whether a frame that fits worse than is usual, or leaves a direction open, is
            aligned anew at the finest level alone, from where features put it too; see
            ``Localizer``.
        refuse_open: with ``check_slips``, whether what stays open is refused: for a camera that can
            go back to where its pose was known.
        color_registration: "estimated": where the colour camera is, is found from the edges of the
            first frames, see ``color_cameras``; "given": colour is taken as it comes. Of several
            cameras in lockstep it is.
    """

    depth_cutoff_m: float = bounded(8.0, 0.0, LARGEST_CUTOFF_M)
    icp_rgb_weight: float = bounded(0.1, 0.0, 1.0)
    confidence_threshold: float = bounded(10.0, 0.0, 12.0)
    iterations: tuple[int, ...] = (4, 5, 10)
    max_surfels: int | None = bounded(None, 1000, 50_000_000)
    coverage_px: float = bounded(0.85, 0.5, 1.0)
    surfel_radius_px: float = bounded(0.9, 0.5, 3.0)
    max_confidence: float = bounded(50.0, 1.0, 10_000.0)
    compaction_interval: int = bounded(10, 1, 10_000)
    unstable_window: int = bounded(200, 1, 100_000)
    fusion_distance_m: float = bounded(0.02, 0.0001, 1.0)
    fusion_angle_deg: float = bounded(45.0, 1.0, 90.0)
    bilateral_sigma_m: float = bounded(0.01, 0.0001, 1.0)
    bilateral_radius_px: int = bounded(2, 0, 10)
    normal_edge_per_m: float = bounded(0.03, 0.001, 10.0)
    icp_distance_m: float = bounded(0.10, 0.001, 1.0)
    icp_angle_deg: float = bounded(40.0, 1.0, 90.0)
    depth_noise_m: float = bounded(0.003, 0.00001, 1.0)
    cauchy_icp: float = bounded(2.0, 0.01, 1000.0)
    cauchy_rgb: float = bounded(1.0, 0.01, 1000.0)
    intensity_noise: float = bounded(0.5, 0.01, 255.0)
    points_per_level: int = bounded(5000, 100, 10_000_000)
    refuse_bad_fits: bool = True
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    relocalisation: str = chosen("ferns", *RELOCALISATIONS)
    loop_closure: str = chosen("none", *LOOP_CLOSURES)
    loops: LoopConfig = field(default_factory=LoopConfig)
    submaps: str = chosen("atlas", *SUBMAPS)
    submap_rules: SubmapConfig = field(default_factory=SubmapConfig)
    motion_mask: str = chosen("geometric", *MOTION_MASKS)
    readout_s: float = bounded(0.0, 0.0, 1.0)
    check_slips: bool = True
    refuse_open: bool = False
    color_registration: str = chosen("given", *COLOR_REGISTRATIONS)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_counts(self, "iterations", 5, 100)

    @classmethod
    def paper(cls) -> SurfelConfig:
        """ElasticFusion as the paper explores it (ICRA 2017, section IV-A): ``PAPER``'s defaults.

        Its loops are closed by deforming the map, and what was added here is off. The other
        parameters have no published value in units of ours and stay as they are;
        docs/exploration.md goes through them.
        """
        published = {name: default for name, (default, _, _) in PAPER.items()}
        own = {"motion_mask": "none", "submaps": "off", "check_slips": False}
        return cls(**published, **own, loop_closure="deformation")  # type: ignore[arg-type]

    @classmethod
    def of_mapper(cls, **options: Any) -> SurfelConfig:
        """Only maps, at the poses of another backend, whose errors would seem to be motion."""
        return cls(**{"motion_mask": "none", "submaps": "off", **options})

    def capacity(self, columns: int) -> int:
        """Surfels that the map of a camera with images of so many columns has room for."""
        if self.max_surfels is not None:
            return self.max_surfels
        return round(500_000 * max(1.0, columns / 160))
