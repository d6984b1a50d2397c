"""Semi-dense direct alignment of two RGB-D images: LSD-SLAM's tracking, with the sensor's depth.

Engel, Schoeps and Cremers, "LSD-SLAM" (ECCV 2014), section 3.3: the points p of the reference with
a strong grey gradient and a depth are transformed into the frame,

    r(p) = I(pi(T p)) - I_ref(p)
    E    = sum Huber(r / s),   s^2 = 2 s_I^2 + (dr/dz s_z)^2

minimised over T by Gauss-Newton, coarse to fine. Depth and its variance s_z^2 come from the sensor
(Nguyen et al. 2012) instead of a filter over many frames, so scale is known and T is in SE(3).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.frame import reduce_depth
from ms_slam_env.geometry import invert, se3_exp
from ms_slam_env.slam.shared.alignment_measures import DepthImage

ITERATIONS = (8, 12, 20)  # most per level, finest first
_GRADIENT = 5.0  # least gradient of a point, grey levels per pixel, as in LSD-SLAM
_DEPTH_EDGE = 0.05  # relative change of depth per pixel that marks an edge
_SIGMA_I = 4.0  # noise of a grey value
_HUBER = 1.5  # standard deviations beyond which the loss is linear
_FEWEST_POINTS = 60
_SMALLEST_STEP = 1e-4  # metres and radians
_SMALLEST_SIDE = 12  # pixels of the coarsest level


@dataclass(frozen=True)
class SemiDenseLevel:
    """One pyramid level of an image, and its points.

    Attributes:
        intrinsics: intrinsics of the level.
        image: (h, w, 3) grey value, and its gradients to the right and down.
        points: (N, 3) metres, from the pixels with a strong gradient and a depth.
        grey: (N,) their grey values.
    """

    intrinsics: Intrinsics
    image: Float32
    points: Float64
    grey: Float64


class SemiDenseAligner:
    """Finds the motion between two images; a substitute for ``odometry.Aligner``."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        shortest = min(intrinsics.shape)
        levels = [k for k in range(len(ITERATIONS)) if not k or shortest >> k >= _SMALLEST_SIDE]
        self._cameras = [intrinsics.resized(*intrinsics.level_size(k)) for k in levels]

    def prepare(self, image: DepthImage) -> list[SemiDenseLevel]:
        """Build all pyramid levels of an image, finest first."""
        return [_level(image, K) for K in self._cameras]

    def align(self, frame: list[SemiDenseLevel], reference: list[SemiDenseLevel]) -> Float64 | None:
        """Align from rest; return T_reference_frame (4, 4).

        None if too few points are in view or they do not constrain the pose."""
        T = np.eye(4)  # T_frame_reference
        for level in reversed(range(len(frame))):
            for _ in range(ITERATIONS[level]):
                step = _step(frame[level], reference[level], T)
                if step is None and level == 0:
                    return None
                if step is None:  # a small image may have few points; finer levels decide
                    break
                T = se3_exp(step) @ T
                if np.linalg.norm(step) < _SMALLEST_STEP:
                    break
        return invert(T)


def _level(image: DepthImage, K: Intrinsics) -> SemiDenseLevel:
    """Build the level with the image size of ``K``."""
    grey, depth, size = image.intensity.astype(np.float32), image.depth, (K.width, K.height)
    if image.depth.shape != K.shape:
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        depth = reduce_depth(depth, size)
    right = 0.5 * cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1)
    down = 0.5 * cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1)
    window = np.ones((3, 3), np.uint8)  # at an object's edge the depth may belong to either side
    is_whole = cv2.dilate(depth, window) < (1 + _DEPTH_EDGE) * cv2.erode(depth, window)
    is_point = (np.hypot(right, down) > _GRADIENT) & is_whole
    points = (K.rays() * depth[..., None])[is_point]
    return SemiDenseLevel(
        K, np.stack([grey, right, down], axis=-1), points, grey[is_point].astype(np.float64)
    )


def _step(
    frame: SemiDenseLevel, reference: SemiDenseLevel, T_frame_reference: Float64
) -> Float64 | None:
    """The Gauss-Newton step (6,) of translation and rotation, T <- exp(step) T."""
    system = normal_equations(frame, reference, T_frame_reference)
    if system is None:
        return None
    values, vectors = np.linalg.eigh(system[0])
    if not values[0] > 1e-7 * values[-1]:
        return None
    return np.asarray(vectors @ ((vectors.T @ system[1]) / values), dtype=np.float64)


def normal_equations(
    frame: SemiDenseLevel, reference: SemiDenseLevel, T_frame_reference: Float64
) -> tuple[Float64, Float64, float] | None:
    """H (6, 6), g (6,) and the mean cost at a pose; None if too few points are in view."""
    K, R = frame.intrinsics, T_frame_reference[:3, :3]
    q = reference.points @ R.T + T_frame_reference[:3, 3]
    pixels = K.project(np.where(q[:, 2:] > 0.05, q, (0.0, 0.0, -1.0)))
    seen = (q[:, 2] > 0.05) & (pixels >= 0).all(axis=1)
    seen &= (pixels[:, 0] < K.width - 1) & (pixels[:, 1] < K.height - 1)
    if seen.sum() < _FEWEST_POINTS:
        return None
    p, q, places = reference.points[seen], q[seen], pixels[seen]
    grey, right, down = _interpolated(frame.image, places).T
    r = grey - reference.grey[seen]
    per_z = 1 / q[:, 2]
    across, along = right * K.fx * per_z, down * K.fy * per_z
    a = np.stack([across, along, -(across * q[:, 0] + along * q[:, 1]) * per_z], axis=1)
    sigma_z = 0.0012 + 0.0019 * (p[:, 2] - 0.4) ** 2
    per_depth = np.einsum("nc,nc->n", a, p @ R.T) / p[:, 2]  # dr/dz, z being the reference's depth
    sigma = np.sqrt(2 * _SIGMA_I**2 + (per_depth * sigma_z) ** 2)
    size = np.abs(r) / sigma
    weight = np.where(size <= _HUBER, 1, _HUBER / np.maximum(size, 1e-9)) / sigma**2
    J = np.concatenate([a, np.cross(q, a)], axis=1)
    cost = np.where(size <= _HUBER, 0.5 * size**2, _HUBER * (size - 0.5 * _HUBER))
    return J.T @ (weight[:, None] * J), -J.T @ (weight * r), float(cost.mean())


def _interpolated(image: Float32, pixels: Float64) -> Float64:
    """Interpolate an image (h, w, c) bilinearly at pixels (N, 2) inside it."""
    column, row = np.floor(pixels).astype(np.int64).T
    right, down = (pixels - np.floor(pixels)).T[..., None]
    top = (1 - right) * image[row, column] + right * image[row, column + 1]
    low = (1 - right) * image[row + 1, column] + right * image[row + 1, column + 1]
    return np.asarray((1 - down) * top + down * low, dtype=np.float64)
