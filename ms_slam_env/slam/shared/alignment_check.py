"""Decides whether to accept an alignment, from its measured statistics.

Registration returns a pose for nearly any pair of images. Every backend measures what a pose
explains (``AlignmentStatistics``), sets its requirements (``AcceptanceThresholds``), and leaves the
decision to ``evaluate_alignment``: odometry, volumetric and sparse SLAM on the host, the surfel
tracker inside a kernel.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import wp

FEWEST_READINGS = 0.05  # share of a frame's pixels that must have depth


class TrackingStatus(IntEnum):
    """Whether a frame was tracked, or the first requirement that its alignment fails."""

    OK = 0
    FEW_POINTS = 1
    LITTLE_OVERLAP = 2
    UNCONSTRAINED = 3
    GEOMETRIC_MISMATCH = 4
    PHOTOMETRIC_MISMATCH = 5
    IMPLAUSIBLE_MOTION = 6
    BLANK = 7
    UNCERTAIN = 8


DISPUTED = (TrackingStatus.GEOMETRIC_MISMATCH, TrackingStatus.PHOTOMETRIC_MISMATCH)
"""Rejections that a comparison with the map's view may overrule."""

MAP_REASONS: dict[int, str] = {
    TrackingStatus.OK: "",
    TrackingStatus.FEW_POINTS: "too few points of the map or of the frame to align",
    TrackingStatus.LITTLE_OVERLAP: "the frame hardly overlaps the map's view",
    TrackingStatus.UNCONSTRAINED: "the view does not constrain the pose",
    TrackingStatus.GEOMETRIC_MISMATCH: "the frame's depth does not fit the map",
    TrackingStatus.PHOTOMETRIC_MISMATCH: "the frame's intensity does not fit the map",
    TrackingStatus.IMPLAUSIBLE_MOTION: "the motion is implausibly large",
    TrackingStatus.BLANK: "the image is black or blank",
    TrackingStatus.UNCERTAIN: "the frame fits the map, but not well enough to be fused",
}
"""Text of each status for a frame aligned with the map."""

VIEW_REASONS: dict[int, str] = MAP_REASONS | {
    TrackingStatus.LITTLE_OVERLAP: "the frame hardly overlaps the view that it is aligned with",
    TrackingStatus.GEOMETRIC_MISMATCH: (
        "the frame's depth does not fit the view that it is aligned with"
    ),
    TrackingStatus.PHOTOMETRIC_MISMATCH: (
        "the frame's intensity does not fit the view that it is aligned with"
    ),
}
"""Text of each status for a frame aligned with another image."""


@dataclass(frozen=True)
class AlignmentStatistics:
    """Statistics of an alignment: how much of a frame it explains; 0 if not measured."""

    matches: float = 0.0  # number of matched points
    overlap: float = 0.0  # share of the frame's readings that land on a reading of the reference
    inlier_ratio: float = 0.0  # share of those within tolerance of its surface
    # share of those too far in front of or behind it for noise to explain.
    depth_conflict_ratio: float = 0.0
    photometric_inlier_ratio: float = 0.0  # share of those with a similar grey value
    correlation: float = 0.0  # normalised, of the fine structure of both grey images
    # standard deviation of fine structure in the image that has more, grey levels.
    texture: float = 0.0
    # RMS distance of the reference's surface from the plane that fits it best.
    relief_m: float = 0.0
    residual_m: float = 0.0  # RMS point-to-plane residual of the inliers, metres
    cost: float = 0.0  # mean truncated cost of the visible points, in [0, 3]
    # standard deviation of the worst-constrained translation or rotation component, leaving out
    # directions that the view does not constrain.
    sigma_m: float = 0.0
    # number of pose directions that the view does not constrain.
    degenerate_directions: float = 0.0
    term_conflict: float = 0.0  # chi squared between the poses that geometry and intensity prefer
    motion_m: float = 0.0  # translation between frame and reference, metres
    rotation_cos: float = 0.0  # cosine of the angle between them


NO_ALIGNMENT = AlignmentStatistics()


@dataclass(frozen=True)
class AcceptanceThresholds:
    """Requirements for accepting an alignment: minima, or maxima of what counts against it.

    The defaults require nothing. See ``AlignmentStatistics``.
    """

    matches: float = 0.0
    overlap: float = 0.0
    inlier_ratio: float = 0.0
    depth_conflict_ratio: float = np.inf
    photometric_inlier_ratio: float = 0.0
    correlation: float = -np.inf
    relief_m: float = 0.0
    cost: float = np.inf
    sigma_m: float = np.inf
    degenerate_directions: float = 6.0
    motion_m: float = np.inf
    rotation_cos: float = -np.inf

    @property
    def tentative(self) -> AcceptanceThresholds:
        """Looser thresholds for an alignment that must be confirmed by a second, nearby one."""
        return replace(
            self,
            inlier_ratio=0.8 * self.inlier_ratio,
            photometric_inlier_ratio=0.7 * self.photometric_inlier_ratio,
        )

    @property
    def confirmation(self) -> AcceptanceThresholds:
        """Thresholds of the second alignment: it may hardly move the pose; wrong poses drift on."""
        return replace(
            self,
            photometric_inlier_ratio=0.93 * self.photometric_inlier_ratio,
            motion_m=0.03,
            rotation_cos=np.cos(np.radians(3.0)),
        )

    def repeated(self, count: int) -> NDArray[Any]:
        """Repeat the thresholds ``count`` times as a structured array for ``DeviceThresholds``."""
        dtype = np.dtype([(field.name, np.float64) for field in fields(self)])
        return np.array([tuple(asdict(self).values())] * count, dtype=dtype)


VIEW_THRESHOLDS = AcceptanceThresholds(
    overlap=0.3,
    inlier_ratio=0.75,
    photometric_inlier_ratio=0.9,
    motion_m=0.3,
    rotation_cos=np.cos(np.radians(30.0)),
)
"""Thresholds for a frame aligned with another image, captured or rendered."""

CONSISTENCY_THRESHOLDS = AcceptanceThresholds(overlap=0.4, inlier_ratio=0.85, correlation=0.45)
"""Thresholds for a frame compared with the map's view (``measure_photometric_consistency``).

In six scenes at 160x120 the correlation was at least 0.88 at true poses, except with a map that had
drifted. With rolling shutter, blur, misregistered colour, changing exposure and patches without
depth all at once, it was 0.5 or more at three of four. At wrong poses found by the tracker, 10 cm
or 10 degrees off or in another scene, it was below 0.35 except for two of 307.
"""

TEXTURELESS_THRESHOLDS = AcceptanceThresholds(overlap=0.4, inlier_ratio=0.95, relief_m=0.05)
"""The same without texture: depth alone must identify the place, and all planes look alike."""

CONVINCING_CORRELATION = 0.7
"""With this correlation a frame is accepted although the tracker's thresholds rejected it.

``ms-slam experiment acceptance_roc``: of the rejected frames that were nearly accepted
(``AcceptanceConfig.doubted``) and have this correlation, nearly all are right.
"""

LEAST_TEXTURE = 2.0  # grey levels; with less there is nothing to correlate


def _device_struct(cls: type) -> Any:
    """Make a Warp struct with the fields of a dataclass, each a float64."""
    annotations = {field.name: wp.float64 for field in fields(cls)}
    members = {"__annotations__": annotations, "__module__": __name__, "__doc__": cls.__doc__}
    return wp.struct(type(f"Device{cls.__name__}", (), members))


DeviceStatistics = _device_struct(AlignmentStatistics)
DeviceThresholds = _device_struct(AcceptanceThresholds)


def evaluate_alignment(statistics: Any, thresholds: Any) -> int:
    """Decide the ``TrackingStatus`` of an alignment.

    On the host it takes ``AlignmentStatistics`` and ``AcceptanceThresholds``; in kernels the same
    code is ``evaluate_on_device`` and takes ``DeviceStatistics`` and ``DeviceThresholds``.
    """
    if statistics.matches < thresholds.matches:
        return TrackingStatus.FEW_POINTS
    if statistics.overlap < thresholds.overlap:
        return TrackingStatus.LITTLE_OVERLAP
    if (
        statistics.sigma_m > thresholds.sigma_m
        or statistics.degenerate_directions > thresholds.degenerate_directions
        or statistics.relief_m < thresholds.relief_m
    ):
        return TrackingStatus.UNCONSTRAINED
    if (
        statistics.inlier_ratio < thresholds.inlier_ratio
        or statistics.depth_conflict_ratio > thresholds.depth_conflict_ratio
    ):
        return TrackingStatus.GEOMETRIC_MISMATCH
    if (
        statistics.photometric_inlier_ratio < thresholds.photometric_inlier_ratio
        or statistics.correlation < thresholds.correlation
        or statistics.cost > thresholds.cost
    ):
        return TrackingStatus.PHOTOMETRIC_MISMATCH
    if (
        statistics.motion_m > thresholds.motion_m
        or statistics.rotation_cos < thresholds.rotation_cos
    ):
        return TrackingStatus.IMPLAUSIBLE_MOTION
    return TrackingStatus.OK


evaluate_on_device = wp.func(evaluate_alignment)

_DEMANDS: dict[int, tuple[tuple[str, str, bool], ...]] = {
    TrackingStatus.FEW_POINTS: (("matches", "points", True),),
    TrackingStatus.LITTLE_OVERLAP: (("overlap", "overlap", True),),
    TrackingStatus.UNCONSTRAINED: (
        ("sigma_m", "sigma", False),
        ("degenerate_directions", "open directions", False),
        ("relief_m", "relief", True),
    ),
    TrackingStatus.GEOMETRIC_MISMATCH: (
        ("inlier_ratio", "inliers", True),
        ("depth_conflict_ratio", "depth conflicts", False),
    ),
    TrackingStatus.PHOTOMETRIC_MISMATCH: (
        ("photometric_inlier_ratio", "similar grey values", True),
        ("correlation", "correlation", True),
        ("cost", "cost", False),
    ),
    TrackingStatus.IMPLAUSIBLE_MOTION: (
        ("motion_m", "motion in metres", False),
        ("rotation_cos", "rotation in degrees", True),
    ),
}
"""Each status to the statistics that it may be due to: field, words, whether least is demanded."""


def failed_demand(statistics: Any, thresholds: Any, status: int) -> str:
    """The figure behind a refusal and what was demanded, as in "cost 1.61, at most 1.42".

    Args:
        statistics: ``AlignmentStatistics``, or a record with its fields.
        thresholds: ``AcceptanceThresholds``, or a record with its fields.
        status: the ``TrackingStatus`` of the alignment.

    Returns:
        The first figure that fails; empty if none does, as where something else refused the frame.
    """
    for name, words, is_least in _DEMANDS.get(status, ()):
        found, demanded = _field(statistics, name), _field(thresholds, name)
        if found < demanded if is_least else found > demanded:
            if name == "rotation_cos":  # the larger the angle, the smaller its cosine
                found, demanded = np.degrees(np.arccos(np.clip([found, demanded], -1.0, 1.0)))
                is_least = False
            return f"{words} {found:.3g}, at {'least' if is_least else 'most'} {demanded:.3g}"
    return ""


def _field(values: Any, name: str) -> float:
    return float(values[name] if isinstance(values, np.void) else getattr(values, name))


def is_photometrically_consistent(found: AlignmentStatistics) -> bool:
    """Whether a frame and the map's view show the same surface."""
    textured = found.texture >= LEAST_TEXTURE
    thresholds = CONSISTENCY_THRESHOLDS if textured else TEXTURELESS_THRESHOLDS
    return evaluate_alignment(found, thresholds) == TrackingStatus.OK


def status_on_appeal(found: AlignmentStatistics) -> TrackingStatus:
    """Decide a doubtful alignment by the map's view: OK, UNCERTAIN or PHOTOMETRIC_MISMATCH."""
    if not is_photometrically_consistent(found):
        return TrackingStatus.PHOTOMETRIC_MISMATCH
    sure = found.texture >= LEAST_TEXTURE and found.correlation >= CONVINCING_CORRELATION
    return TrackingStatus.OK if sure else TrackingStatus.UNCERTAIN
