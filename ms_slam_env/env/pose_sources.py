"""Sources of the estimated pose: SLAM, forward kinematics, or the truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult


@dataclass(frozen=True)
class FrameObservation:
    """A frame, and the poses known without looking at the image.

    Attributes:
        frame: the live frame.
        T_world_camera: (4, 4) true pose.
        T_world_camera_kinematic: (4, 4) pose from forward kinematics, which start at the true start
            pose.
        T_previous_camera_kinematic: (4, 4) motion since the last tracked frame from forward
            kinematics; it accumulates while tracking is lost.
        T_world_previous_estimate: (4, 4) estimate at the last tracked frame.
    """

    frame: RGBDFrame
    T_world_camera: Float64
    T_world_camera_kinematic: Float64
    T_previous_camera_kinematic: Float64
    T_world_previous_estimate: Float64


class PoseSource(ABC):
    """Estimates the pose of a frame and fuses the frame into the map."""

    def locate(self, slam: SlamBackend, seen: FrameObservation) -> TrackResult:
        """Fuse a frame other than the first at the pose of :meth:`predict`."""
        return slam.fuse(seen.frame, self.predict(seen))

    @abstractmethod
    def predict(self, seen: FrameObservation) -> Float64:
        """Predict T_world_camera (4, 4) without looking at the frame."""

    def handle_dropped_frame(
        self, seen: FrameObservation, tracking_ok: bool, inlier_fraction: float
    ) -> TrackResult:
        """Report the state at a dropped frame; nothing is tracked or fused."""
        pose = self.predict(seen)
        return TrackResult(pose, tracking_ok, inlier_fraction=inlier_fraction, processed=False)


class SlamPose(PoseSource):
    """SLAM tracks the frame without using the joints."""

    def locate(self, slam: SlamBackend, seen: FrameObservation) -> TrackResult:
        """Pose from SLAM alone."""
        return slam.track(seen.frame)

    def predict(self, seen: FrameObservation) -> Float64:
        """The last estimate."""
        return seen.T_world_previous_estimate


class GuessedSlamPose(PoseSource):
    """SLAM tracks the frame, starting from the motion that the kinematics report."""

    def locate(self, slam: SlamBackend, seen: FrameObservation) -> TrackResult:
        """Track, starting from the last estimate moved as the joints moved."""
        return slam.track(seen.frame, self.predict(seen))

    def predict(self, seen: FrameObservation) -> Float64:
        """The last estimate, moved as the joints moved."""
        return seen.T_world_previous_estimate @ seen.T_previous_camera_kinematic


class KinematicPose(PoseSource):
    """Forward kinematics alone, with their noise and bias; SLAM only maps."""

    def predict(self, seen: FrameObservation) -> Float64:
        """The kinematic pose."""
        return seen.T_world_camera_kinematic


class TruePose(PoseSource):
    """The true pose, as from a perfect tracker; SLAM only maps."""

    def predict(self, seen: FrameObservation) -> Float64:
        """The true pose."""
        return seen.T_world_camera


POSE_SOURCES: dict[str, type[PoseSource]] = {
    "slam": SlamPose,
    "slam-kinematics": GuessedSlamPose,
    "kinematics": KinematicPose,
    "ground_truth": TruePose,
}
"""Pose source of each name of the option ``pose``."""

KINEMATIC_SOURCES = ("slam-kinematics", "kinematics")
"""The sources that read joints."""
