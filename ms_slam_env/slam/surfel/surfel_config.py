"""Parameters of the surfel SLAM and its loop closure, named as in the paper where it has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.config import Checked, bounded, check_counts, chosen
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M


@dataclass(frozen=True)
class LoopConfig(Checked):
    """When to look for loops, when to accept them, and when to deform the map.

    ElasticFusion's published values are for 640x480 at 30 Hz and minutes of recording. These values
    are shares of the image or of the map where possible, and frames elsewhere.

    Attributes:
        window: frames for which an unseen surfel stays active.
        interval: frames between two searches for a loop.
        coverage: least share of the image that the inactive part of the map must cover.
        largest_m: largest correction of the camera's position that is accepted.
        smallest_m: a correction that moves a point at 1 m by less than this deforms nothing; the
            inactive surfels become active where they are.
        global_interval: frames between two searches among keyframes; a multiple of ``interval``.
        drift_share: largest accepted distance to a keyframe, as a share of the path since then.
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
    """Thresholds from which a refused frame gets a second check against the map's view.

    The check renders the map from the pose that was found, and accepts the frame, calls it
    uncertain, or refuses it; see ``alignment_check.status_on_appeal``.

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
    """When a pixel fits the map, and when a frame's alignment is accepted.

    Attributes:
        inlier_sigmas: a matched point is an inlier if its residual is below this number of standard
            deviations of the depth noise. Chosen together with ``inliers``, see
            ``acceptance_thresholds``: at a right pose, Gaussian depth noise of ``depth_noise_m``
            leaves all points inliers, 2.5 times as much noise 89 %, 4 times as much 68 %.
        conflict_sigmas: the depth of a matched point conflicts if it differs along the ray by more
            than this number of standard deviations.
        texture: least intensity gradient of a textured point, grey levels per pixel (sum of both
            components).
        photometric_inlier: largest photometric residual of an inlier, grey levels, at the usual
            scale of residuals.
        points: fewest matched points.
        overlap: least share of the map's points in view that the live image covers.
        inliers: least share of the matched points that are inliers.
        alike: least share of the textured points that are photometric inliers.
        conflicts: largest share of the matched points whose depth conflicts.
        cost: largest mean truncated cost of the visible points, in [0, 3].
        doubted: laxer values, from which a refused frame gets a second check.
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
    """When to start a submap, how to find older ones, and when to join two.

    Attributes:
        after: a submap starts after this many consecutive frames that show something and are
            refused.
        fewest_keyframes: a lost map with fewer keyframes is dropped.
        interval: frames between two searches for an older submap.
        dissimilarity: largest dissimilarity of a frame and a keyframe that may show the same place,
            as a share of the ferns.
        looks: number of searches that must agree on the relative pose of two submaps.
        step_m: distance between the places of two such searches, unless ``step_deg`` is met or
            ``interval`` frames lie between them.
        step_deg: rotation between two such searches; see ``step_m``.
        agreement_m: searches agree if their camera positions differ by at most this,
        agreement_deg: and their rotations by at most this.
        guess_sigma_m: standard deviation of each coordinate of the pose at which a submap starts,
            if the caller guessed it; larger without a guess.
        guess_sigma_deg: standard deviation of its rotation about each axis; larger without a guess.
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
        depth_cutoff_m: readings beyond this depth are ignored. Readings with more than 48 mm of
            noise, by default those beyond 4 m, count less the noisier they are.
        icp_rgb_weight: weight w of the photometric term against the geometric one, [0, 1]: 0 is
            geometry alone, 1 photometry alone; ``normal_equations`` has the exact cost.
        confidence_threshold: observations after which a surfel is stable, [0, 12].
        iterations: Gauss-Newton iterations per pyramid level, finest first.
        max_surfels: capacity of the map, per env; None: 500,000 for images of up to 160 columns,
            and in proportion to the columns for wider ones.
        coverage_px: a reading starts a new surfel only if no surfel of its surface projects this
            close to its pixel.
        surfel_radius_px: radius of a new surfel in pixels of the view that made it.
        max_confidence: limit of a surfel's confidence, which is the weight of its past.
        compaction_interval: frames between two removals of unstable surfels.
        unstable_window: a surfel below the confidence threshold is removed if it is not seen for
            this many frames.
        fusion_distance_m: largest distance along the ray between a reading and the surfel that
            it updates, at 1 m; grows with depth squared like the sensor's noise.
        fusion_angle_deg: largest angle between their normals.
        bilateral_sigma_m: width of the filter in depth at 1 m; grows with depth squared.
        bilateral_radius_px: half-size of the filter's window, pixels.
        normal_edge_per_m: a larger jump of inverse depth between neighbours (of a 160-column image)
            is an edge and has no normal, 1/m.
        icp_distance_m: largest distance between associated points in tracking.
        icp_angle_deg: largest angle between their normals.
        depth_noise_m: axial noise of depth at 1 m, grows with depth squared; the unit of
            geometric residuals.
        cauchy_icp: scale of Cauchy's loss on geometric residuals, in units of that noise.
        cauchy_rgb: scale of Cauchy's loss on photometric residuals, in standard deviations.
        intensity_noise: standard deviation of a grey value, grey levels.
        points_per_level: pixels in the last iteration of tracking, about; the other iterations use
            three tenths of that.
        refuse_bad_fits: whether a frame that fits the map badly counts as lost and stays out of the
            map. If not, every frame is fused at the pose that alignment found, as in ElasticFusion
            without relocalisation, and the map may show things twice.
        acceptance: which pixels and frames fit the map.
        loop_closure: "none": align frames with the whole map, however old; "deformation": align
            them with its recent part, and deform the map where that meets the old part again.
        loops: parameters of "deformation".
        relocalisation: where to search for a lost frame, besides around the last good pose:
            "ferns": at similar keyframes; "features": the same, and then where ORB features put
            it; "local": nowhere else.
        submaps: "atlas": a lost camera continues in a new map, which is joined to the old one
            when that is seen again; "off": it waits until it finds its map. With several cameras in
            lockstep, a lost one always waits.
        submap_rules: parameters of "atlas".
        motion_mask: "geometric": moving things are neither tracked nor mapped, see
            ``free_space_mask``; "none": the world is assumed to be static.
        readout_s: time that a rolling shutter takes from the first row to the last, see
            ``rolling_shutter``; 0: all rows are exposed at once. Needs frames with timestamps.
        check_slips: whether a frame that fits worse than usual, or leaves a direction
            unconstrained, is aligned again at the finest level only, also from where features put
            it; see ``Localizer``.
        refuse_open: with ``check_slips``, whether a frame that still leaves a direction
            unconstrained is refused; for a camera that can return to where its pose was known.
        color_registration: "estimated": estimate the offset of the colour camera from edges in the
            first frames, see ``color_cameras``; "given": use colour as it comes. With several
            cameras in lockstep, colour is always used as it comes.
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

        Loops are closed by deforming the map, and our own additions are off. The other parameters
        have no published values in our units and keep their defaults; docs/exploration.md lists
        them.
        """
        published = {name: default for name, (default, _, _) in PAPER.items()}
        own = {"motion_mask": "none", "submaps": "off", "check_slips": False}
        return cls(**published, **own, loop_closure="deformation")  # type: ignore[arg-type]

    @classmethod
    def of_mapper(cls, **options: Any) -> SurfelConfig:
        """For mapping at poses of another backend: no mask, which would take its errors for motion.

        ``options`` are further parameters.
        """
        return cls(**{"motion_mask": "none", "submaps": "off", **options})

    def capacity(self, columns: int) -> int:
        """Capacity of the map, in surfels, for images of ``columns`` columns."""
        if self.max_surfels is not None:
            return self.max_surfels
        return round(500_000 * max(1.0, columns / 160))
