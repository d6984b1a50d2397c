"""Where the colour camera is, from the edges that colour and depth share.

Objects end where depth steps, and mostly so does their colour. The offset of the cameras is the one
that puts the near sides of depth steps where the colour's gradient is steepest, summed over many
frames (after Levinson and Thrun, "Automatic online calibration of cameras and lasers", RSS 2013).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution, minimize

from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.registration import Registration

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

FEWEST_EDGES = 500  # points on depth steps that a registration is estimated from
LEAST_GAIN = 1.1  # of their mean gradient, by which cameras are believed to be apart
_STEP = 0.04  # of inverse depth, 1/m
_RANGES = ((0.85, 1.15), (-0.06, 0.06))  # of focal ratio and baseline, metres
_SIMPLEX = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.004]])
_BLURS_PX = (1.5, 0.7)  # of the gradients: to find the place, and to find it exactly
_STEEPEST = 3.0  # times the mean gradient: beyond it an edge is an edge
_BORDER = 2  # rows and columns that are left out


def depth_edges(depth: Float32, intrinsics: Intrinsics) -> Float64:
    """Points (N, 3) on the near side of the steps of a depth image (H, W), between the pixels."""
    K, inverse = intrinsics, np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0)
    inside = np.zeros(depth.shape, dtype=bool)
    inside[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    points = []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        beside = np.roll(inverse, (-y, -x), (0, 1))
        v, u = np.nonzero(inside & (beside > 0) & (inverse - beside > _STEP))
        z = depth[v, u].astype(np.float64)
        u_edge, v_edge = u + 0.5 * x, v + 0.5 * y
        points.append(np.stack([(u_edge - K.cx) / K.fx * z, (v_edge - K.cy) / K.fy * z, z], 1))
    return np.concatenate(points)


def estimate_registration(
    colors: Sequence[NDArray[np.uint8]], edges: Sequence[Float64], intrinsics: Intrinsics
) -> Registration | None:
    """Focal ratio and baseline of the colour camera.

    Args:
        colors: images (H, W, 3) of the colour camera.
        edges: points (N, 3) of each, as ``depth_edges`` finds them.
        intrinsics: of the depth camera.

    Returns:
        None where there are too few edges, or those of colour and depth lie together as they are.
    """
    given = [(color, points) for color, points in zip(colors, edges, strict=True) if len(points)]
    if sum(len(points) for _, points in given) < FEWEST_EDGES:
        return None
    places = [points for _, points in given]
    coarse, fine = ([_gradient(color, blur) for color, _ in given] for blur in _BLURS_PX)

    def against(gradients: Sequence[Float32], at: Float64) -> float:
        return -_steepness(gradients, places, intrinsics, *at)

    def cost(at: Float64) -> float:
        return against(coarse, at)

    found = differential_evolution(cost, _RANGES, maxiter=25, popsize=8, rng=0, polish=False)
    best = minimize(
        lambda at: against(fine, at),
        found.x,
        method="Nelder-Mead",
        options={"maxfev": 200, "initial_simplex": found.x + _SIMPLEX},
    )
    if best.fun > LEAST_GAIN * against(fine, np.array([1.0, 0.0])):  # both are negative
        return None
    return Registration(float(best.x[0]), float(best.x[1]))


def _gradient(color: NDArray[np.uint8], blur_px: float) -> Float32:
    """Steepness (H, W) of an image's grey values, 1 on average."""
    grey = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY).astype(np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) / 8
    relative = np.minimum(slope / (slope.mean() + 1), _STEEPEST)
    return np.asarray(cv2.GaussianBlur(relative, (0, 0), blur_px))


def _steepness(
    gradients: Sequence[Float32],
    places: Sequence[Float64],
    intrinsics: Intrinsics,
    focal_ratio: float,
    baseline_m: float,
) -> float:
    """Mean gradient at the places where a colour camera sees the edges."""
    K, total = intrinsics, 0.0
    for gradient, (x, y, z) in zip(gradients, (points.T for points in places), strict=True):
        u = focal_ratio * K.fx * (x - baseline_m) / z + K.cx
        v = focal_ratio * K.fy * y / z + K.cy
        where = u.astype(np.float32)[None], v.astype(np.float32)[None]
        total += cv2.remap(
            gradient, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).sum()
    return total / sum(map(len, places))
