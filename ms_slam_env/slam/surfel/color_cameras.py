"""Estimate and undo the offset of a colour camera that is not registered with depth.

Objects end where depth steps, and their colour usually ends there, too. So the offset is the one
that puts the near sides of depth steps where the colour gradient is steepest, summed over many
frames (after Levinson and Thrun, "Automatic online calibration of cameras and lasers", RSS 2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import differential_evolution, minimize

from ms_slam_env._runtime.arrays import Float32, Float64, UInt8
from ms_slam_env.camera import Intrinsics
from ms_slam_env.camera.depth_registration import Registration
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ArrayOf, ListOf
from ms_slam_env.slam.slam_backend import TrackResult
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam

FEWEST_EDGES = 500  # points on depth steps needed to estimate the offset
LEAST_GAIN = 1.1  # factor in mean gradient from which an offset is believed
_STEP = 0.04  # of inverse depth, 1/m
_RANGES = ((0.85, 1.15), (-0.06, 0.06))  # of focal ratio and baseline, metres
_SIMPLEX = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.004]])
_BLURS_PX = (1.5, 0.7)  # of the gradients, for the coarse and the fine search
_STEEPEST = 3.0  # times the mean gradient, at which gradients are clipped
_BORDER = 2  # rows and columns left out at each side


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


def estimate_camera_offset(
    colors: Sequence[NDArray[np.uint8]], edges: Sequence[Float64], intrinsics: Intrinsics
) -> Registration | None:
    """Focal ratio and baseline of the colour camera.

    Args:
        colors: images (H, W, 3) of the colour camera.
        edges: edge points (N, 3) of each frame, from ``depth_edges``.
        intrinsics: of the depth camera.

    Returns:
        None if there are too few edges, or if colour and depth edges already coincide.
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
    """Gradient magnitude (H, W) of an image's grey values, about 1 on average."""
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
    """Mean gradient at the pixels where a colour camera sees the edges."""
    K, total = intrinsics, 0.0
    for gradient, (x, y, z) in zip(gradients, (points.T for points in places), strict=True):
        u = focal_ratio * K.fx * (x - baseline_m) / z + K.cx
        v = focal_ratio * K.fy * y / z + K.cy
        where = u.astype(np.float32)[None], v.astype(np.float32)[None]
        total += cv2.remap(
            gradient, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).sum()
    return total / sum(map(len, places))


# The offset is estimated after this many points on depth steps, or this many frames.
ENOUGH_EDGES = 6000
MOST_FRAMES = 60


class EstimatedColorCamera(Saved):
    """Estimates the offset of the colour camera from the first frames, and then undoes it.

    Until then, at most ``MOST_FRAMES`` frames are kept. Once the offset is found, they are tracked
    again with registered colour, into a new map. If one of them was lost or was fused at a known
    pose, the map stays as it is and only later frames are registered.
    """

    saved = (
        *("_start", "_colors", "_depths", "_guesses", "_times", "_edges", "_is_whole", "_offset"),
    )

    def __init__(self) -> None:
        self.reset(None)

    def reset(self, T_world_camera: ArrayLike | None) -> None:
        """Start over at a pose (4, 4)."""
        self._start: Float64 = np.eye(4) if T_world_camera is None else np.array(T_world_camera)
        self._offset: Float64 = np.full(2, np.nan)  # focal ratio and baseline; NaN: not known yet
        self._is_whole = True  # the map holds the kept frames and no others
        self._forget()

    def state_like(self) -> Any:
        """See ``Stateful``."""
        like = {
            "colors": ListOf(ArrayOf(np.uint8, ("height", "width", 3)), "first frames"),
            "depths": ListOf(ArrayOf(np.float32, ("height", "width"), least=0), "first frames"),
            "guesses": ListOf(ArrayOf(np.float64, (4, 4), may_be_nan=True), "first frames"),
            "times": ListOf(0.0, "first frames"),
        }
        return super().state_like() | like

    def _forget(self) -> None:
        self._edges = 0
        self._colors: list[UInt8] = []
        self._depths: list[Float32] = []
        self._guesses: list[Float64] = []
        self._times: list[float] = []

    def registered(self, slam: BatchedSurfelSlam, color: UInt8, depth: Float32) -> UInt8:
        """Colour (1, H, W, 3) as the depth camera would see it."""
        focal_ratio, baseline_m = self._offset.tolist()
        if not self._is_known or (focal_ratio, baseline_m) == (1.0, 0.0):
            return color
        camera = Registration(focal_ratio, baseline_m)
        return camera.register(color[0], depth[0], slam.intrinsics)[None]

    @property
    def _is_known(self) -> bool:
        return bool(np.isfinite(self._offset[0]))

    def track(
        self,
        slam: BatchedSurfelSlam,
        color: UInt8,
        depth: Float32,
        guess: ArrayLike | None,
        time_s: float,
    ) -> TrackResult:
        """Track a frame, and estimate the offset once enough frames are kept."""
        result = slam.track(color, depth, [guess], [time_s])[0]
        if self._is_known:
            return result
        if self._depths and self._depths[0].shape != depth[0].shape:
            self._forget()  # ``reconfigure``
        self._colors.append(color[0].copy())
        self._depths.append(depth[0].copy())
        self._guesses.append(np.full((4, 4), np.nan) if guess is None else np.array(guess))
        self._times.append(time_s)
        self._edges += len(depth_edges(depth[0], slam.intrinsics))
        self._is_whole &= result.tracking_ok and slam.last_frame() + 1 == len(self._times)
        if self._edges < ENOUGH_EDGES and len(self._times) < MOST_FRAMES:
            return result
        edges = [depth_edges(one, slam.intrinsics) for one in self._depths]
        found = estimate_camera_offset(self._colors, edges, slam.intrinsics)
        camera = found or Registration(1.0, 0.0)
        self._offset = np.array([camera.focal_ratio, camera.baseline_m])
        if found is not None and self._is_whole:
            result = self._track_again(slam)
        self._forget()
        return result

    def _track_again(self, slam: BatchedSurfelSlam) -> TrackResult:
        """Start over with the kept frames."""
        slam.reset(self._start)
        kept: Any = zip(self._colors, self._depths, self._guesses, self._times, strict=True)
        for color, depth, guess, time_s in kept:
            registered = self.registered(slam, color[None], depth[None])
            known = guess if np.isfinite(guess).all() else None
            result = slam.track(registered, depth[None], [known], [time_s])[0]
        return result
