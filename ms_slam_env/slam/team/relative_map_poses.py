"""Hypotheses of the relative pose of two robots' maps.

Relocalisation needs a view from about the same place. Two robots usually see the same things from
different places, so points are also matched by appearance (SIFT, Lowe, IJCV 2004). Since depth
gives every point in 3D, three matches yield a relative pose (RANSAC, Fischler and Bolles, 1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, intensity_image
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, transform_points
from ms_slam_env.geometry.point_clouds import umeyama
from ms_slam_env.slam.shared.map_fit import query_frames
from ms_slam_env.slam.shared.orb_features import InverseDepth
from ms_slam_env.slam.slam_backend import SlamBackend

FEATURES, RELOCALISATION = "features", "relocalisation"
SOURCES = (FEATURES, RELOCALISATION)

_LEAST_MATCHES = 8
_MATCH_TOLERANCE_M = 0.02  # at 1 m
_MAGNIFY_TO = 640  # columns of the image in which corners are detected
_MOST_FEATURES = 400
_RATIO = 0.8  # the best match must be this much better than the second best
_TRIALS = 300  # RANSAC samples of three matches
_REFITS = 3
_RELOCALISED_WEIGHT = 30.0  # of a relocalised frame, in feature matches


@dataclass(frozen=True)
class RobotRun:
    """A robot that has finished its path.

    Raises:
        InputError: no frame, or the number of poses or flags differs from that of frames.
    """

    backend: SlamBackend  # its SLAM, with the map
    frames: Sequence[RGBDFrame]  # N, all that it captured
    estimates: Float64  # (N, 4, 4) T_map_camera, in the frame of its own map
    tracked: NDArray[np.bool_]  # (N,) bool

    def __post_init__(self) -> None:
        count = len(self.frames)
        if count == 0:
            raise InputError("a robot without frames has no map to merge")
        if self.estimates.shape != (count, 4, 4) or self.tracked.shape != (count,):
            raise InputError(
                f"{count} frames but poses of shape {self.estimates.shape} and flags of shape "
                f"{self.tracked.shape}"
            )


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis of T_a_b from one frame."""

    T_a_b: Float64  # (4, 4) transforms points of map b into map a
    weight: float  # matches behind it
    source: str  # one of ``SOURCES``


def hypotheses_from_features(a: RobotRun, b: RobotRun, queries: int) -> list[Hypothesis]:
    """Hypotheses from similar points in a frame of robot b and in frames of robot a."""
    K = a.backend.intrinsics
    known = [landmarks(a.frames[k], a.estimates[k], K) for k in query_frames(a, queries)]
    rng = np.random.default_rng(0)  # fixed, so that the same maps merge in the same way
    found = []
    for index in query_frames(b, queries):
        seen = landmarks(b.frames[index], b.estimates[index], K)
        match = match_landmarks(known, seen, _LEAST_MATCHES, _MATCH_TOLERANCE_M, rng)
        if match is not None:
            found.append(Hypothesis(match[0], float(match[1]), FEATURES))
    return found


def hypotheses_from_relocalisation(
    a: RobotRun, b: RobotRun, queries: int, patience: int
) -> list[Hypothesis]:
    """Hypotheses from frames of robot b that robot a's SLAM relocalises in its map.

    SLAM gets no guess: it sees a black frame, loses tracking, and then sees up to ``patience``
    consecutive frames of robot b, as after a kidnapping. Its state is restored afterwards.
    """
    state = a.backend.get_state()
    height, width = b.frames[0].depth.shape
    black = RGBDFrame(np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32))
    found = []
    for first in query_frames(b, queries):
        a.backend.track(black)
        for index in range(first, min(first + patience, len(b.frames))):
            result = a.backend.track(b.frames[index])
            if result.tracking_ok:
                if b.tracked[index]:
                    T_a_b = result.T_world_camera @ invert(b.estimates[index])
                    found.append(Hypothesis(T_a_b, _RELOCALISED_WEIGHT, RELOCALISATION))
                break
        a.backend.set_state(state)
    return found


@dataclass(frozen=True)
class Landmarks:
    """Points of one frame."""

    points: Float64  # (N, 3) in the frame of the robot's map
    descriptors: NDArray[np.float32]  # (N, 128) float32, RootSIFT
    depth_m: Float64  # (N,) distance along the optical axis; their error grows with it


def landmarks(frame: RGBDFrame, T_map_camera: Float64, K: Intrinsics) -> Landmarks:
    """Extract recognisable points with known depth; none in an image without texture."""
    grey = intensity_image(frame.color).round().astype(np.uint8)
    n = max(1, round(_MAGNIFY_TO / K.width))
    image = cv2.resize(grey, (n * K.width, n * K.height), interpolation=cv2.INTER_CUBIC)
    corners, described = cv2.SIFT.create(nfeatures=_MOST_FEATURES).detectAndCompute(image, None)
    if described is None:
        return Landmarks(np.zeros((0, 3)), np.zeros((0, 128), np.float32), np.zeros(0))
    # A pixel of the image covers n x n of the magnified one; centres lie at integers.
    pixels = (np.asarray(cv2.KeyPoint.convert(corners), dtype=np.float64) + 0.5) / n - 0.5
    inverse = InverseDepth(frame.depth).at(pixels)
    known = inverse > 0
    depth = 1.0 / inverse[known]
    rays = K.rays_at(pixels[known])
    kept = described[known]
    root = np.sqrt(kept / np.maximum(kept.sum(axis=1, keepdims=True), 1e-9))
    points = transform_points(T_map_camera, rays * depth[:, None])
    return Landmarks(points, root.astype(np.float32), depth)


def match_landmarks(
    a: Sequence[Landmarks],
    b: Landmarks,
    least_inliers: int,
    tolerance_m: float,
    rng: np.random.Generator,
) -> tuple[Float64, int] | None:
    """Find where the frame of robot b lies in map a: T_a_b (4, 4) and the matches behind it.

    Uses the frame of robot a with most inliers, at least ``least_inliers``. An inlier fits to
    ``tolerance_m`` at 1 m; the tolerance grows with depth squared, as the sensor's noise does.
    """
    best: tuple[Float64, int] | None = None
    for one in a:
        rows_a, rows_b = _matches(one.descriptors, b.descriptors)
        if len(rows_a) < least_inliers:
            continue
        depth = np.maximum(one.depth_m[rows_a], b.depth_m[rows_b])
        tolerances = tolerance_m * np.maximum(1.0, depth) ** 2
        found = _rigid_motion(one.points[rows_a], b.points[rows_b], tolerances, rng)
        if found is not None and found[1] >= least_inliers and (best is None or found[1] > best[1]):
            best = found
    return best


def _matches(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (M,) of descriptors that are mutually best and clearly better than the second."""
    none = np.zeros(0, dtype=np.int64)
    if len(a) < 2 or len(b) < 2:
        return none, none
    likeness = a @ b.T  # of unit vectors
    there, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    rows = np.flatnonzero(back[there] == np.arange(len(a)))
    columns = there[rows]
    first = likeness[rows, columns]
    rest = likeness[rows].copy()
    rest[np.arange(len(rows)), columns] = -1.0
    distance, second = (np.sqrt(np.maximum(2 - 2 * x, 0)) for x in (first, rest.max(axis=1)))
    clear = distance < _RATIO * second
    return rows[clear], columns[clear]


def _rigid_motion(
    a: Float64, b: Float64, tolerances: Float64, rng: np.random.Generator
) -> tuple[Float64, int] | None:
    """T_a_b (4, 4) that fits most of the pairs (N, 3), (N, 3), and their number; None if none."""
    best, most = None, 2
    trials = np.stack([rng.choice(len(a), 3, replace=False) for _ in range(_TRIALS)])
    for chosen in trials[_are_rigid(a[trials], b[trials], tolerances[trials])]:
        inliers = _fitting(_alignment(b[chosen], a[chosen]), a, b, tolerances)
        if inliers.sum() > most:
            best, most = inliers, int(inliers.sum())
    if best is None:
        return None
    for _ in range(_REFITS):
        T = _alignment(b[best], a[best])
        best = _fitting(T, a, b, tolerances)
        if best.sum() < 3:
            return None
    return T, int(best.sum())


def _are_rigid(a: Float64, b: Float64, tolerances: Float64) -> NDArray[np.bool_]:
    """Which triangles (T, 3, 3) have equal side lengths in both sets, none of them tiny."""
    rigid = np.ones(len(a), dtype=bool)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        in_a, in_b = (np.linalg.norm(x[:, i] - x[:, j], axis=1) for x in (a, b))
        slack = tolerances[:, i] + tolerances[:, j]
        rigid &= (np.minimum(in_a, in_b) >= slack) & (np.abs(in_a - in_b) <= slack)
    return rigid


def _fitting(T_a_b: Float64, a: Float64, b: Float64, tolerances: Float64) -> NDArray[np.bool_]:
    return np.linalg.norm(transform_points(T_a_b, b) - a, axis=1) <= tolerances


def _alignment(source: Float64, target: Float64) -> Float64:
    R, t, _ = umeyama(source, target)
    return make_pose(R, t)
