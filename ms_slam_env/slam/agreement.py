"""How well a frame at an estimated pose agrees with the image that it was aligned with.

OpenCV's and Open3D's odometry return a pose for nearly any pair of images; whether to believe it
is decided here, the same way for both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import relative_angle
from ms_slam_env.slam.base import Float32, Float64

FEWEST_READINGS = 0.05  # share of a frame's pixels that must have depth
_ALIKE_LEVELS = 20.0  # largest difference of grey values once their median is taken away


@dataclass(frozen=True)
class DepthImage:
    """A depth image with its intensity, sensed or rendered.

    Attributes:
        depth: (H, W) float32 metres; 0 = no reading.
        intensity: (H, W) float32 in [0, 255].
    """

    depth: Float32
    intensity: Float32

    @property
    def readings(self) -> float:
        """Share of the pixels that have depth."""
        return float((self.depth > 0).mean())


@dataclass(frozen=True)
class Agreement:
    """What an alignment explains of a frame.

    Attributes:
        overlap: share of the frame's readings that land on a reading of the reference.
        inlier_fraction: share of those within the distance of its surface.
        alike_fraction: share of those with a like grey value.
        residual_m: RMS point-to-plane residual of the inliers, metres.
    """

    overlap: float
    inlier_fraction: float
    alike_fraction: float
    residual_m: float


@dataclass(frozen=True)
class AgreementLimits:
    """What a believable alignment has.

    Attributes:
        overlap: least share of the frame that the reference shows.
        inliers: least share of it that fits the reference's depth.
        alike: least share of it that fits the reference's intensity.
        motion_m: largest translation between the two, metres.
        motion_rad: largest rotation, radians.
    """

    overlap: float = 0.3
    inliers: float = 0.75
    alike: float = 0.9
    motion_m: float = 0.3
    motion_rad: float = float(np.radians(30.0))

    @property
    def worth_another_look(self) -> AgreementLimits:
        """Laxer limits, for an alignment that is repeated from close by before it is believed."""
        return replace(self, inliers=0.8 * self.inliers, alike=0.7 * self.alike)

    @property
    def confirmation(self) -> AgreementLimits:
        """Limits of the repetition, which must hardly move the pose; wrong poses drift on."""
        return replace(self, alike=0.93 * self.alike, motion_m=0.03, motion_rad=np.radians(3.0))

    def reason(self, agreement: Agreement, T_reference_frame: Float64) -> str:
        """Why the alignment is not believable; empty if it is."""
        motion_m = float(np.linalg.norm(T_reference_frame[:3, 3]))
        turned = relative_angle(np.eye(3), T_reference_frame[:3, :3])
        if motion_m > self.motion_m or turned > self.motion_rad:
            return "the motion is implausibly large"
        if agreement.overlap < self.overlap:
            return "the frame hardly overlaps the view that it is aligned with"
        if agreement.inlier_fraction < self.inliers:
            return "the frame's depth does not fit the view that it is aligned with"
        if agreement.alike_fraction < self.alike:
            return "the frame's intensity does not fit the view that it is aligned with"
        return ""


def measure_agreement(
    frame: DepthImage,
    reference: DepthImage,
    T_reference_frame: Float64,
    intrinsics: Intrinsics,
    samples: int = 5000,
) -> Agreement:
    """Compare a frame with a reference of the same camera by projective association.

    A reading is an inlier within 2 cm + 1 cm/m^2 of the reference's surface, the axial noise of
    structured light growing with depth squared. About ``samples`` readings are looked at; more
    than the default do not change a verdict.
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
    if not seen.any():
        return Agreement(0.0, 0.0, 0.0, 0.0)
    row, column, points = row[seen], column[seen], points[seen]
    residual = _distance_to_surface(points, row, column, reference.depth, intrinsics)
    inlier = residual <= 0.02 + 0.01 * points[:, 2] ** 2
    difference = frame.intensity[v, u][seen] - reference.intensity[row, column]
    alike = np.abs(difference - np.median(difference)) <= _ALIKE_LEVELS
    squares = residual[inlier] ** 2
    return Agreement(
        overlap=float(seen.mean()),
        inlier_fraction=float(inlier.mean()),
        alike_fraction=float(alike.mean()),
        residual_m=float(np.sqrt(squares.mean())) if inlier.any() else 0.0,
    )


def _back_project(
    u: NDArray[np.int64], v: NDArray[np.int64], depth: Float64, intrinsics: Intrinsics
) -> Float64:
    """Points (N, 3) of pixels with a depth, camera frame."""
    x = (u - intrinsics.cx) / intrinsics.fx
    y = (v - intrinsics.cy) / intrinsics.fy
    return np.stack([x * depth, y * depth, depth], axis=1)


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
