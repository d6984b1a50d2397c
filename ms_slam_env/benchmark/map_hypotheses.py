"""Guesses of where two robots' maps lie relative to each other, and which of them agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark.map_matching import landmarks, match_landmarks
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, relative_angle, se3_exp, se3_log, transform_points
from ms_slam_env.slam.base import SlamBackend

Float64 = NDArray[np.float64]

FEATURES, RELOCALISATION = "features", "relocalisation"
SOURCES = (FEATURES, RELOCALISATION)

_LEAST_MATCHES = 8
_MATCH_TOLERANCE_M = 0.02  # at 1 m
_RELOCALISED_WEIGHT = 30.0  # of a relocalised frame, in matches of features


@dataclass(frozen=True)
class RobotRun:
    """A robot that has finished its path.

    Attributes:
        backend: its SLAM, with the map.
        frames: N, what it saw.
        estimates: (N, 4, 4) T_map_camera, in the frame of its own map.
        tracked: (N,) bool.

    Raises:
        InputError: no frame, or another number of poses or flags than of frames.
    """

    backend: SlamBackend
    frames: Sequence[RGBDFrame]
    estimates: Float64
    tracked: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Refuse what does not belong together."""
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
    """A guess from one frame.

    Attributes:
        T_a_b: (4, 4) maps points of map b into map a.
        weight: matches behind it.
        source: one of ``SOURCES``.
    """

    T_a_b: Float64
    weight: float
    source: str


def recognised(a: RobotRun, b: RobotRun, queries: int) -> list[Hypothesis]:
    """From points that look alike in a frame of robot b and in frames of robot a."""
    K = a.backend.intrinsics
    known = [landmarks(a.frames[k], a.estimates[k], K) for k in query_frames(a, queries)]
    rng = np.random.default_rng(0)  # fixed: the same maps merge in the same way
    found = []
    for index in query_frames(b, queries):
        seen = landmarks(b.frames[index], b.estimates[index], K)
        match = match_landmarks(known, seen, _LEAST_MATCHES, _MATCH_TOLERANCE_M, rng)
        if match is not None:
            found.append(Hypothesis(match[0], float(match[1]), FEATURES))
    return found


def relocalised(a: RobotRun, b: RobotRun, queries: int, patience: int) -> list[Hypothesis]:
    """From frames of robot b that the SLAM of robot a finds in its map; that is left as it was.

    SLAM is told nothing: it sees a black frame, is lost, and then sees up to ``patience``
    consecutive frames of robot b, as after a kidnapping.
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


def query_frames(robot: RobotRun, count: int) -> list[int]:
    """Indices of at most ``count`` tracked frames, evenly spread over the path."""
    tracked = np.flatnonzero(robot.tracked)
    if len(tracked) == 0:
        return []
    picked = np.linspace(0, len(tracked) - 1, min(count, len(tracked))).round().astype(int)
    return tracked[picked].tolist()


def consensus(
    hypotheses: Sequence[Hypothesis], centre: Float64, agree_m: float, agree_deg: float
) -> list[Hypothesis]:
    """The hypotheses that agree with the one that most agree with, by their number.

    Two agree if they put the point ``centre`` (3,) of map b at about the same place and turn alike.
    """
    best: list[Hypothesis] = []
    for one in hypotheses:
        agreeing = []
        for other in hypotheses:
            distance, angle = pose_difference(one.T_a_b, other.T_a_b, centre)
            if distance <= agree_m and angle <= agree_deg:
                agreeing.append(other)
        if len(agreeing) > len(best):
            best = agreeing
    return best


def pose_difference(T: Float64, T_other: Float64, point: Float64) -> tuple[float, float]:
    """Distance in metres between where two poses put a point (3,), and their angle in degrees."""
    moved = transform_points(T, point[None]) - transform_points(T_other, point[None])
    angle = relative_angle(T[:3, :3], T_other[:3, :3])
    return float(np.linalg.norm(moved)), float(np.degrees(angle))


def mean_pose(hypotheses: Sequence[Hypothesis], centre: Float64) -> Float64:
    """Weighted mean (4, 4) of hypotheses that lie close together, taken about a point of map b."""
    T_b_centre = np.eye(4)
    T_b_centre[:3, 3] = centre
    poses = [hypothesis.T_a_b @ T_b_centre for hypothesis in hypotheses]
    twists = [se3_log(invert(poses[0]) @ pose) for pose in poses]
    weights = [hypothesis.weight for hypothesis in hypotheses]
    return poses[0] @ se3_exp(np.average(twists, axis=0, weights=weights)) @ invert(T_b_centre)
