"""Where the estimated pose comes from: SLAM, forward kinematics, or the truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult


@dataclass(frozen=True)
class FrameObservation:
    """A frame and what is known of where it was taken, without looking at it.

    Attributes:
        frame: the live frame.
        T_world_camera: (4, 4) the truth.
        T_world_camera_kinematic: (4, 4) by forward kinematics, which start at the true start pose.
        T_previous_camera_kinematic: (4, 4) motion since the last tracked frame, by forward
            kinematics: while tracking is lost it adds up.
        T_world_previous_estimate: (4, 4) estimate at the last tracked frame.
    """

    frame: RGBDFrame
    T_world_camera: Float64
    T_world_camera_kinematic: Float64
    T_previous_camera_kinematic: Float64
    T_world_previous_estimate: Float64


class PoseSource(ABC):
    """Says where a frame was taken and has it fused into the map."""

    def locate(self, slam: SlamBackend, seen: FrameObservation) -> TrackResult:
        """Fuse a frame that is not the first at the pose of :meth:`predict`."""
        return slam.fuse(seen.frame, self.predict(seen))

    @abstractmethod
    def predict(self, seen: FrameObservation) -> Float64:
        """T_world_camera (4, 4) as far as it is known without looking at the frame."""

    def handle_dropped_frame(
        self, seen: FrameObservation, tracking_ok: bool, inlier_fraction: float
    ) -> TrackResult:
        """What is known at a moment whose frame was not delivered; nothing is tracked or fused."""
        pose = self.predict(seen)
        return TrackResult(pose, tracking_ok, inlier_fraction=inlier_fraction, processed=False)


class SlamPose(PoseSource):
    """SLAM tracks the frame; it knows nothing of joints."""

    def locate(self, slam: SlamBackend, seen: FrameObservation) -> TrackResult:
        """Track."""
        return slam.track(seen.frame)

    def predict(self, seen: FrameObservation) -> Float64:
        """Where it last was."""
        return seen.T_world_previous_estimate


class GuessedSlamPose(PoseSource):
    """SLAM tracks the frame, starting from the motion that the kinematics report."""

    def locate(self, slam: SlamBackend, seen: FrameObservation) -> TrackResult:
        """Track from the last estimate, moved as the joints moved."""
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
    """The true pose: what a perfect tracker would leave to mapping."""

    def predict(self, seen: FrameObservation) -> Float64:
        """The true pose."""
        return seen.T_world_camera


POSE_SOURCES: dict[str, type[PoseSource]] = {
    "slam": SlamPose,
    "slam-kinematics": GuessedSlamPose,
    "kinematics": KinematicPose,
    "ground_truth": TruePose,
}
"""Name of the option ``pose`` to variant."""

KINEMATIC_SOURCES = ("slam-kinematics", "kinematics")
"""Those that read joints."""
