"""Base class of backends that process one frame after another: track, then accept or lose."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, check_frame
from ms_slam_env.geometry import check_pose, invert, make_pose, orthonormal, so3_exp
from ms_slam_env.slam.shared.alignment_check import (
    FEWEST_READINGS,
    NO_ALIGNMENT,
    VIEW_THRESHOLDS,
    AcceptanceThresholds,
    AlignmentStatistics,
)
from ms_slam_env.slam.shared.alignment_measures import DepthImage, overlay
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult

TURN_RAD = np.radians(10.0)
STEP_M = 0.1
_TRIALS = 6  # motions tried, out of all that are compared
_SAMPLES = 600  # readings used to score a motion


def _signed_axes(size: float) -> Float64:
    """Vectors (7, 3): none, and both ways along each axis."""
    return size * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


MOTIONS = np.stack(
    [
        make_pose(so3_exp(turn), step)
        for turn in _signed_axes(float(TURN_RAD))
        for step in _signed_axes(STEP_M)
    ]
)
"""Motions (49, 4, 4): no turn or one of 10 degrees, with no step or one of 10 cm."""


def motion_hypotheses(
    frame: DepthImage, reference: DepthImage, T_last_camera: Float64, intrinsics: Intrinsics
) -> Float64:
    """Initial motions T_reference_frame (7, 4, 4), in the order in which they are tried.

    First the last motion ``T_last_camera`` (4, 4), in case it continues; then the best of
    ``MOTIONS``, scored by how well they align the frame with the reference in depth and intensity.
    """
    # Made rigid because it carries over from frame to frame: multiplying pose and last motion
    # repeatedly amplifies rounding errors of the rotation by 2.4 per frame.
    scores = overlay(frame, reference, MOTIONS, intrinsics, _SAMPLES).scores
    best = np.argsort(-scores, kind="stable")[:_TRIALS]
    return np.concatenate([orthonormal(T_last_camera)[None], MOTIONS[best]])


class PreparedFrame(Protocol):
    """A frame as a backend tracks it."""

    @property
    def readings(self) -> float:
        """Share of the pixels that have depth."""


SEARCHED_FRAMES = 100
"""Lost frames in a row that are all searched for; after that only every tenth is."""

Frame = TypeVar("Frame", bound=PreparedFrame)
Match = TypeVar("Match")


@dataclass(frozen=True)
class Attempt(Generic[Match]):
    """A pose that a frame may have."""

    T_world_camera: Float64  # (4, 4) the pose
    statistics: AlignmentStatistics  # statistics of its alignment
    reason: str  # why it is not accepted; empty if it is
    match: Match  # the backend's additional result
    refusal: str = ""  # the figure behind the reason, and what was demanded


class FrameByFrameSlam(Saved, SlamBackend, Generic[Frame, Match]):
    """A backend that tries one pose after another, and takes the first that passes its check.

    A subclass defines how to prepare a frame, which poses to try, and how the map grows. While
    tracking is lost the pose is held and nothing is fused.

    Attributes:
        fewest_readings: share of a frame's pixels that must have depth.
    """

    fewest_readings = FEWEST_READINGS
    saved: ClassVar[tuple[str, ...]] = ("_pose", "_motion", "_lost_frames")

    def __init__(self, intrinsics: Intrinsics) -> None:
        intrinsics.check_pinhole("SLAM")
        self.intrinsics = intrinsics
        self.reset()

    def _judge_views(self, is_stock: bool) -> None:
        """Apply ``VIEW_THRESHOLDS`` to alignments with a view; none for a stock backend."""
        self._thresholds = AcceptanceThresholds() if is_stock else VIEW_THRESHOLDS
        if is_stock:
            self.fewest_readings = 0.0

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self._pose = np.array(check_pose(pose, "T_world_camera"))
        self._motion = np.eye(4)  # from the frame before to the last one
        self._lost_frames = 0  # since the last tracked frame
        self._clear()

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and extend the map; see ``SlamBackend``."""
        check_frame(frame, self.intrinsics)
        guess = None
        if T_world_camera_guess is not None:
            guess = np.array(check_pose(T_world_camera_guess, "T_world_camera_guess"))
        prepared = self._prepare(frame)
        which = "frame" if self._has_map else "first frame"
        if prepared.readings < self.fewest_readings:
            return self._lose(f"the {which} has too few depth readings", NO_ALIGNMENT)
        if not self._has_map:
            reason = self._why_no_start(prepared)
            return self._lose(reason, NO_ALIGNMENT) if reason else self._take(frame, prepared)
        reason, statistics, refusal = self._no_attempt, NO_ALIGNMENT, ""
        for attempt in self._attempts(prepared, guess):
            if not attempt.reason:
                return self._accept(frame, prepared, attempt)
            reason, statistics, refusal = attempt.reason, attempt.statistics, attempt.refusal
        self._miss(frame, prepared)
        return self._lose(reason, statistics, refusal)

    def mark_lost(self) -> None:
        """Treat tracking as lost; see ``SlamBackend``."""
        self._motion = np.eye(4)
        self._lost_frames = self._lost_frames + 1 if self._has_map else 0

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` into the map at a known pose (4, 4), without tracking."""
        check_frame(frame, self.intrinsics)
        self._pose = np.array(check_pose(T_world_camera, "T_world_camera"))
        return self._take(frame, self._prepare(frame))

    def _take(self, frame: RGBDFrame, prepared: Frame) -> TrackResult:
        """Continue from a frame whose pose is known."""
        self._motion = np.eye(4)
        self._lost_frames = 0
        self._start_from(frame, prepared)
        return TrackResult(self._pose.copy(), True)

    def _accept(self, frame: RGBDFrame, prepared: Frame, attempt: Attempt[Match]) -> TrackResult:
        """Accept a frame's pose, and extend the map."""
        relocalised, self._lost_frames = self._lost_frames > 0, 0
        before, self._pose = self._pose, attempt.T_world_camera
        self._motion = np.eye(4) if relocalised else invert(before) @ self._pose
        self._extend(frame, prepared, attempt)
        found = attempt.statistics
        figures = found.inlier_ratio, found.residual_m
        return TrackResult(self._pose.copy(), True, relocalised, *figures, overlap=found.overlap)

    def _lose(self, reason: str, statistics: AlignmentStatistics, refusal: str = "") -> TrackResult:
        """Keep the pose and the map while tracking is lost."""
        self.mark_lost()
        figures = statistics.inlier_ratio, statistics.residual_m
        return TrackResult(
            self._pose.copy(),
            False,
            False,
            *figures,
            reason,
            overlap=statistics.overlap,
            refusal=refusal,
        )

    @property
    def _searches(self) -> bool:
        """Whether to search farther away for a frame not found near the last pose.

        A search costs many times as much as tracking. After `SEARCHED_FRAMES` failures the camera
        is hardly near, and every tenth frame is enough to notice its return.
        """
        return self._lost_frames < SEARCHED_FRAMES or self._lost_frames % 10 == 0

    @property
    @abstractmethod
    def _has_map(self) -> bool:
        """Whether there is something to track against."""

    @property
    @abstractmethod
    def _no_attempt(self) -> str:
        """Why tracking failed if there was no pose to try."""

    @abstractmethod
    def _clear(self) -> None:
        """Forget the map."""

    @abstractmethod
    def _prepare(self, frame: RGBDFrame) -> Frame:
        """Prepare a frame for tracking."""

    def _why_no_start(self, prepared: Frame) -> str:
        """Why a first frame with enough readings cannot start the map; empty if it can."""
        return ""

    @abstractmethod
    def _attempts(self, prepared: Frame, guess: Float64 | None) -> Iterator[Attempt[Match]]:
        """Poses of the frame, in the order in which they are tried."""

    @abstractmethod
    def _start_from(self, frame: RGBDFrame, prepared: Frame) -> None:
        """Fuse a frame at the current pose, which is known."""

    @abstractmethod
    def _extend(self, frame: RGBDFrame, prepared: Frame, attempt: Attempt[Match]) -> None:
        """Fuse a frame tracked at the current pose, if it adds enough."""

    def _miss(self, frame: RGBDFrame, prepared: Frame) -> None:
        """Handle a frame that was not found anywhere."""
