"""Whether an alignment is right: what is measured of one, and the one decision on it.

Registration returns a pose for nearly any pair of images. Every backend measures what a pose
explains (``AlignmentStatistics``), states what it demands (``AcceptanceThresholds``), and leaves
the decision to ``evaluate_alignment``: odometry, volumetric and sparse SLAM on the host, the
surfel tracker inside a kernel.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from enum import IntEnum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import relative_angle
from ms_slam_env.slam.base import Float32, Float64

FEWEST_READINGS = 0.05  # share of a frame's pixels that must have depth
_PHOTOMETRIC_LEVELS = 20.0  # largest difference of grey values once their median is taken away
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601
_WINDOW = 11  # pixels of the view; variations over longer distances are shading, not texture
_SMOOTHING = 3
_FEWEST_PIXELS = 100


class TrackingStatus(IntEnum):
    """Whether a frame was tracked, or the first demand that its alignment does not meet."""

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
"""Refusals that a look at the map's view may overrule."""

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
"""The status in words where a frame was aligned with the map."""

VIEW_REASONS: dict[int, str] = MAP_REASONS | {
    TrackingStatus.LITTLE_OVERLAP: "the frame hardly overlaps the view that it is aligned with",
    TrackingStatus.GEOMETRIC_MISMATCH: (
        "the frame's depth does not fit the view that it is aligned with"
    ),
    TrackingStatus.PHOTOMETRIC_MISMATCH: (
        "the frame's intensity does not fit the view that it is aligned with"
    ),
}
"""The status in words where a frame was aligned with another image."""


@dataclass(frozen=True)
class AlignmentStatistics:
    """What an alignment explains of a frame; 0 where it was not measured."""

    matches: float = 0.0  # number of matched points
    overlap: float = 0.0  # share of the frame's readings that land on a reading of the reference
    inlier_ratio: float = 0.0  # share of those within the distance of its surface
    # share of those so far in front of or behind it that no noise explains it.
    depth_conflict_ratio: float = 0.0
    photometric_inlier_ratio: float = 0.0  # share of those with a like grey value
    correlation: float = 0.0  # normalised, of the fine structure of both grey images
    # standard deviation of their fine structure, of the image that has more, grey levels.
    texture: float = 0.0
    # RMS distance of the reference's surface from the plane that fits it best.
    relief_m: float = 0.0
    residual_m: float = 0.0  # RMS point-to-plane residual of the inliers, metres
    cost: float = 0.0  # mean truncated cost of the visible points, in [0, 3]
    # standard deviation of the worst translation or rotation component that the view constrains.
    sigma_m: float = 0.0
    # number of directions of the pose that it does not constrain.
    degenerate_directions: float = 0.0
    term_conflict: float = 0.0  # chi squared between the poses that geometry and intensity ask for
    motion_m: float = 0.0  # translation between frame and reference, metres
    rotation_cos: float = 0.0  # cosine of the angle between them


NO_ALIGNMENT = AlignmentStatistics()


@dataclass(frozen=True)
class AcceptanceThresholds:
    """What an accepted alignment has: at least, or of what speaks against it at most.

    By default nothing is demanded. See ``AlignmentStatistics``.
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
        """Laxer ones, for an alignment that is repeated from close by before it is accepted."""
        return replace(
            self,
            inlier_ratio=0.8 * self.inlier_ratio,
            photometric_inlier_ratio=0.7 * self.photometric_inlier_ratio,
        )

    @property
    def confirmation(self) -> AcceptanceThresholds:
        """Those of the repetition, which must hardly move the pose; wrong poses drift on."""
        return replace(
            self,
            photometric_inlier_ratio=0.93 * self.photometric_inlier_ratio,
            motion_m=0.03,
            rotation_cos=np.cos(np.radians(3.0)),
        )

    def repeated(self, count: int) -> NDArray[Any]:
        """The same (count,) times, as a structured array for ``DeviceThresholds``."""
        dtype = np.dtype([(field.name, np.float64) for field in fields(self)])
        return np.array([tuple(asdict(self).values())] * count, dtype=dtype)


VIEW_THRESHOLDS = AcceptanceThresholds(
    overlap=0.3,
    inlier_ratio=0.75,
    photometric_inlier_ratio=0.9,
    motion_m=0.3,
    rotation_cos=np.cos(np.radians(30.0)),
)
"""Of a frame aligned with another image, sensed or rendered."""

CONSISTENCY_THRESHOLDS = AcceptanceThresholds(overlap=0.4, inlier_ratio=0.85, correlation=0.45)
"""Of a frame laid upon the map's view from its pose; see ``measure_photometric_consistency``.

In six scenes at 160x120 the correlation was at least 0.88 at true poses, but for a map that had
drifted; with a rolling shutter, blur, misregistered colour, changing exposure and patches without
depth, all at once, it was 0.5 or more at three of four. At poses that the tracker had come to,
10 cm or 10 degrees off or in another scene, it was below 0.35 but for two of 307.
"""

TEXTURELESS_THRESHOLDS = AcceptanceThresholds(overlap=0.4, inlier_ratio=0.95, relief_m=0.05)
"""The same where there is nothing to correlate: depth alone must tell the place; planes look alike.
"""

CONVINCING_CORRELATION = 0.7
"""With this a frame that the tracker's thresholds refused is right after all.

``ms-slam experiment acceptance_roc``: of the frames that the thresholds refuse, that are nearly
accepted (``AcceptanceConfig.doubted``) and have such a correlation, nearly all are right.
"""

LEAST_TEXTURE = 2.0  # grey levels; with less there is nothing to correlate


def _device_struct(cls: type) -> Any:
    """The Warp struct with the fields of a dataclass, each a float64."""
    annotations = {field.name: wp.float64 for field in fields(cls)}
    members = {"__annotations__": annotations, "__module__": __name__, "__doc__": cls.__doc__}
    return wp.struct(type(f"Device{cls.__name__}", (), members))


DeviceStatistics = _device_struct(AlignmentStatistics)
DeviceThresholds = _device_struct(AcceptanceThresholds)


def evaluate_alignment(statistics: Any, thresholds: Any) -> int:
    """The ``TrackingStatus`` of an alignment.

    On the host of ``AlignmentStatistics`` and ``AcceptanceThresholds``; in kernels the same lines
    are ``evaluate_on_device``, of ``DeviceStatistics`` and ``DeviceThresholds``.
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


@dataclass(frozen=True)
class DepthImage:
    """A depth image with its intensity, sensed or rendered."""

    depth: Float32  # (H, W) float32 metres; 0 = no reading
    intensity: Float32  # (H, W) float32 in [0, 255]

    @property
    def readings(self) -> float:
        """Share of the pixels that have depth."""
        return float((self.depth > 0).mean())


def measure_alignment(
    frame: DepthImage,
    reference: DepthImage,
    T_reference_frame: Float64,
    intrinsics: Intrinsics,
    samples: int = 5000,
) -> AlignmentStatistics:
    """Compare a frame with a reference of the same camera by projective association.

    A reading is an inlier within 2 cm + 1 cm/m^2 of the reference's surface, the axial noise of
    structured light growing with depth squared. About ``samples`` readings are looked at; more
    than the default do not change the decision.
    """
    v, u = np.nonzero(frame.depth > 0)
    step = max(1, len(v) // samples)
    v, u = v[::step], u[::step]
    depth = frame.depth[v, u].astype(np.float64)
    points = _back_project(u, v, depth, intrinsics)
    points = points @ T_reference_frame[:3, :3].T + T_reference_frame[:3, 3]
    ahead = points[:, 2] > 1e-3
    pixels = np.full((len(points), 2), -1.0)
    pixels[ahead] = intrinsics.project(points[ahead])
    column, row = np.clip(np.rint(pixels), -1, 1e6).astype(np.int64).T
    # The last row and column have no neighbour to take the normal from.
    seen = (column >= 0) & (column < intrinsics.width - 1)
    seen &= (row >= 0) & (row < intrinsics.height - 1)
    seen[seen] = reference.depth[row[seen], column[seen]] > 0
    motion = AlignmentStatistics(
        motion_m=float(np.linalg.norm(T_reference_frame[:3, 3])),
        rotation_cos=float(np.cos(relative_angle(np.eye(3), T_reference_frame[:3, :3]))),
    )
    if not seen.any():
        return motion
    row, column, points = row[seen], column[seen], points[seen]
    residual = _distance_to_surface(points, row, column, reference.depth, intrinsics)
    inlier = residual <= 0.02 + 0.01 * points[:, 2] ** 2
    difference = frame.intensity[v, u][seen] - reference.intensity[row, column]
    alike = np.abs(difference - np.median(difference)) <= _PHOTOMETRIC_LEVELS
    squares = residual[inlier] ** 2
    return replace(
        motion,
        overlap=float(seen.mean()),
        inlier_ratio=float(inlier.mean()),
        photometric_inlier_ratio=float(alike.mean()),
        residual_m=float(np.sqrt(squares.mean())) if inlier.any() else 0.0,
    )


def check_alignment(
    frame: DepthImage,
    reference: DepthImage,
    T_reference_frame: Float64,
    intrinsics: Intrinsics,
    thresholds: AcceptanceThresholds,
    samples: int = 5000,
) -> tuple[AlignmentStatistics, str]:
    """What ``measure_alignment`` finds, and why that is not accepted; empty if it is."""
    found = measure_alignment(frame, reference, T_reference_frame, intrinsics, samples)
    return found, VIEW_REASONS[evaluate_alignment(found, thresholds)]


def _back_project(
    u: NDArray[np.int64], v: NDArray[np.int64], depth: Float64, intrinsics: Intrinsics
) -> Float64:
    """Points (N, 3) of pixels with a depth, camera frame."""
    return intrinsics.rays_at(np.stack([u, v], axis=1)) * depth[:, None]


def _distance_to_surface(
    points: Float64,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    depth: Float32,
    intrinsics: Intrinsics,
) -> Float64:
    """Distances (N,) of points to the planes through the pixels and their neighbours."""

    def corner(down: int, right: int) -> Float64:
        z = depth[row + down, column + right].astype(np.float64)
        return _back_project(column + right, row + down, z, intrinsics)

    here, right, below = corner(0, 0), corner(0, 1), corner(1, 0)
    normal = np.cross(right - here, below - here)
    length = np.linalg.norm(normal, axis=1)
    flat = (right[:, 2] > 0) & (below[:, 2] > 0) & (length > 0)
    normal[~flat] = (0.0, 0.0, 1.0)
    normal[flat] /= length[flat, None]
    return np.abs(np.einsum("nc,nc->n", points - here, normal))


def measure_photometric_consistency(
    color: NDArray[np.uint8],
    depth: Float32,
    view_intensity: Float32,
    view_depth: Float32,
    cutoff_m: float,
) -> AlignmentStatistics:
    """Lay a frame upon the map's view from its pose, pixel by pixel.

    The tracker explains a frame with a gain and a bias of its own, and self-similar textures fit
    themselves at many places about as well as noise permits. Here the images are compared once
    more, without that freedom. A reading is an inlier within 2 cm + 2 cm/m^2 of the view's depth.

    Args:
        color: (H, W, 3).
        depth: (H, W) metres; 0 = no reading.
        view_intensity: (h, w) every n-th row and column of the camera's image.
        view_depth: (h, w) metres; 0 where the map is empty.
        cutoff_m: readings beyond are no part of the map.
    """
    step = -(-depth.shape[0] // view_depth.shape[0])
    sensed = depth[::step, ::step]
    reading = (sensed > 0) & (sensed <= cutoff_m)
    both = reading & (view_depth > 0)
    if both.sum() < _FEWEST_PIXELS:
        return NO_ALIGNMENT
    grey = color[::step, ::step].astype(np.float32) @ _LUMA
    tolerance = 0.02 + 0.02 * sensed[both] ** 2
    one, other = _fine_structure(grey, both), _fine_structure(view_intensity, both)
    norms = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return AlignmentStatistics(
        overlap=float(both.sum() / reading.sum()),
        inlier_ratio=float((np.abs(view_depth - sensed)[both] <= tolerance).mean()),
        correlation=float((one * other).sum()) / norms if norms > 0 else 0.0,
        texture=float(np.sqrt(max((one[both] ** 2).mean(), (other[both] ** 2).mean()))),
        relief_m=_relief(view_depth, both),
    )


def is_photometrically_consistent(found: AlignmentStatistics) -> bool:
    """Whether a frame and the map's view show the same."""
    textured = found.texture >= LEAST_TEXTURE
    thresholds = CONSISTENCY_THRESHOLDS if textured else TEXTURELESS_THRESHOLDS
    return evaluate_alignment(found, thresholds) == TrackingStatus.OK


def status_on_appeal(found: AlignmentStatistics) -> TrackingStatus:
    """OK, UNCERTAIN or PHOTOMETRIC_MISMATCH: what the map's view says of a doubtful alignment."""
    if not is_photometrically_consistent(found):
        return TrackingStatus.PHOTOMETRIC_MISMATCH
    sure = found.texture >= LEAST_TEXTURE and found.correlation >= CONVINCING_CORRELATION
    return TrackingStatus.OK if sure else TrackingStatus.UNCERTAIN


def _relief(depth: Float32, where: NDArray[np.bool_]) -> float:
    """RMS distance in metres, along the rays, from the plane that fits the depth best.

    The inverse depth of a plane is linear in the image.
    """
    v, u = np.nonzero(where)
    inverse = 1.0 / depth[where].astype(np.float64)
    places = np.stack([u, v, np.ones_like(u)], axis=1).astype(np.float64)
    plane = np.linalg.lstsq(places, inverse, rcond=None)[0]
    residual = (inverse - places @ plane) / inverse**2
    return float(np.sqrt((residual**2).mean()))


def _fine_structure(image: Float32, where: NDArray[np.bool_]) -> Float32:
    """Image less its local mean, slightly smoothed; 0 outside ``where``."""
    weight = where.astype(np.float32)
    window = (_WINDOW, _WINDOW)
    local = cv2.blur(image * weight, window) / np.maximum(cv2.blur(weight, window), 1e-6)
    detail = np.where(where, image - local, 0).astype(np.float32)
    return cv2.blur(detail, (_SMOOTHING, _SMOOTHING)) * weight
