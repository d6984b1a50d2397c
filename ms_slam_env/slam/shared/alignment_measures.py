"""Measures alignments on the host; ``alignment_check`` decides on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import relative_angle
from ms_slam_env.slam.shared.alignment_check import (
    NO_ALIGNMENT,
    VIEW_REASONS,
    AcceptanceThresholds,
    AlignmentStatistics,
    evaluate_alignment,
    failed_demand,
)

_PHOTOMETRIC_LEVELS = 20.0  # largest difference of grey values after subtracting the median
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601
_WINDOW = 11  # pixels of the view; variations over longer distances are shading, not texture
_SMOOTHING = 3
_FEWEST_PIXELS = 100


@dataclass(frozen=True)
class DepthImage:
    """A depth image with its intensity, captured or rendered."""

    depth: Float32  # (H, W) float32 metres; 0 = no reading
    intensity: Float32  # (H, W) float32 in [0, 255]

    @property
    def readings(self) -> float:
        """Share of the pixels that have depth."""
        return float((self.depth > 0).mean())


@dataclass(frozen=True)
class Overlay:
    """Depth readings of a frame, transformed by M motions and projected into a reference.

    Attributes:
        looked_at: number of readings transformed by each motion.
        counts: (M,) number of them that land on a reading of the reference, for each motion.
        inlier: (sum of counts,) whether each of these lies on its surface, ordered by motion.
        alike: (sum of counts,) whether each has a similar grey value.
        residual: (sum of counts,) distance of each from its surface, metres.
    """

    looked_at: int
    counts: NDArray[np.int64]
    inlier: NDArray[np.bool_]
    alike: NDArray[np.bool_]
    residual: Float64

    @property
    def scores(self) -> Float64:
        """Score (M,) of each motion: overlap times the sum of both ratios; 0 without overlap."""
        which = np.repeat(np.arange(len(self.counts)), self.counts)
        good = [
            np.bincount(which[fits], minlength=len(self.counts)) / np.maximum(self.counts, 1)
            for fits in (self.inlier, self.alike)
        ]
        return np.asarray(self.counts / max(self.looked_at, 1) * (good[0] + good[1]))


def overlay(
    frame: DepthImage,
    reference: DepthImage,
    T_reference_frame: Float64,
    intrinsics: Intrinsics,
    samples: int,
) -> Overlay:
    """Project about ``samples`` readings of a frame into a reference by each motion (M, 4, 4)."""
    v, u = np.nonzero(frame.depth > 0)
    step = max(1, len(v) // samples)
    v, u = v[::step], u[::step]
    points = _back_project(u, v, frame.depth[v, u].astype(np.float64), intrinsics)
    R, t = T_reference_frame[:, :3, :3], T_reference_frame[:, None, :3, 3]
    moved = points @ R.transpose(0, 2, 1) + t  # (M, N, 3)
    ahead = moved[..., 2] > 1e-3
    pixels = np.full((*ahead.shape, 2), -1.0)
    pixels[ahead] = intrinsics.project(moved[ahead])
    column, row = np.moveaxis(np.clip(np.rint(pixels), -1, 1e6).astype(np.int64), -1, 0)
    # The last row and column lack the neighbour needed for the normal.
    seen = (column >= 0) & (column < intrinsics.width - 1)
    seen &= (row >= 0) & (row < intrinsics.height - 1)
    seen[seen] = reference.depth[row[seen], column[seen]] > 0
    row, column, landed = row[seen], column[seen], moved[seen]
    counts = seen.sum(axis=1)
    grey = np.broadcast_to(frame.intensity[v, u], seen.shape)[seen]
    difference = grey - reference.intensity[row, column]
    own = np.split(difference, np.cumsum(counts)[:-1])
    median = [np.median(part) if len(part) else np.float32(0) for part in own]
    residual = _distance_to_surface(landed, row, column, reference.depth, intrinsics)
    return Overlay(
        looked_at=len(v),
        counts=counts,
        inlier=residual <= 0.02 + 0.01 * landed[:, 2] ** 2,
        alike=np.abs(difference - np.repeat(median, counts)) <= _PHOTOMETRIC_LEVELS,
        residual=residual,
    )


def measure_alignment(
    frame: DepthImage,
    reference: DepthImage,
    T_reference_frame: Float64,
    intrinsics: Intrinsics,
    samples: int = 5000,
) -> AlignmentStatistics:
    """Compare a frame with a reference of the same camera by projective association.

    A reading is an inlier within 2 cm + 1 cm/m^2 of the reference's surface, since the axial noise
    of structured light grows with depth squared. About ``samples`` readings are compared; more than
    the default do not change the decision.
    """
    motion = AlignmentStatistics(
        motion_m=float(np.linalg.norm(T_reference_frame[:3, 3])),
        rotation_cos=float(np.cos(relative_angle(np.eye(3), T_reference_frame[:3, :3]))),
    )
    laid = overlay(frame, reference, T_reference_frame[None], intrinsics, samples)
    if not len(laid.inlier):
        return motion
    squares = laid.residual[laid.inlier] ** 2
    return replace(
        motion,
        overlap=float(laid.counts[0] / laid.looked_at),
        inlier_ratio=float(laid.inlier.mean()),
        photometric_inlier_ratio=float(laid.alike.mean()),
        residual_m=float(np.sqrt(squares.mean())) if laid.inlier.any() else 0.0,
    )


def check_alignment(
    frame: DepthImage,
    reference: DepthImage,
    T_reference_frame: Float64,
    intrinsics: Intrinsics,
    thresholds: AcceptanceThresholds,
    samples: int = 5000,
) -> tuple[AlignmentStatistics, str, str]:
    """Measure an alignment, and say why it is not accepted, and by which figure; empty if it is."""
    found = measure_alignment(frame, reference, T_reference_frame, intrinsics, samples)
    status = evaluate_alignment(found, thresholds)
    return found, VIEW_REASONS[status], failed_demand(found, thresholds, status)


def _back_project(
    u: NDArray[np.int64], v: NDArray[np.int64], depth: Float64, intrinsics: Intrinsics
) -> Float64:
    """Points (N, 3) in the camera frame from pixels with depth."""
    return intrinsics.rays_at(np.stack([u, v], axis=1)) * depth[:, None]


def _distance_to_surface(
    points: Float64,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    depth: Float32,
    intrinsics: Intrinsics,
) -> Float64:
    """Distances (N,) of points to the planes through the pixels and their neighbours."""

    rows, columns = (
        np.concatenate([row, row, row + 1]),
        np.concatenate([column, column + 1, column]),
    )
    z = depth[rows, columns].astype(np.float64)
    here, right, below = np.split(_back_project(columns, rows, z, intrinsics), 3)
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
    """Compare a frame with the map's view from its pose, pixel by pixel.

    The tracker fits a gain and a bias for each frame, and self-similar textures match themselves at
    many places almost to within noise. Here the images are compared again without that freedom. A
    reading is an inlier within 2 cm + 2 cm/m^2 of the view's depth.

    Args:
        color: (H, W, 3).
        depth: (H, W) metres; 0 = no reading.
        view_intensity: (h, w) every n-th row and column of the camera's image.
        view_depth: (h, w) metres; 0 where the map is empty.
        cutoff_m: readings beyond are not part of the map.
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
