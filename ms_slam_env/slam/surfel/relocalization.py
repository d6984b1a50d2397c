"""What finding the pose again once tracking is lost needs and offers; here nothing is found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.shared.alignment_check import AlignmentStatistics
from ms_slam_env.slam.shared.alignment_measures import measure_photometric_consistency
from ms_slam_env.slam.shared.ferns import Candidate
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.acceptance import Alignment
from ms_slam_env.slam.surfel.rendering import ModelView

Bool = NDArray[np.bool_]
Int32 = NDArray[np.int32]


@dataclass(frozen=True)
class Images:
    """Frames as sensed."""

    color: NDArray[np.uint8]  # (B, H, W, 3) uint8
    depth: NDArray[np.float32]  # (B, H, W) float32 metres; 0 = no reading


class FrameAligner(Protocol):
    """What relocalization may ask of the SLAM about the current frames."""

    def align_from(
        self, origins: Float64, hypotheses: Float64, thresholds: NDArray[Any]
    ) -> Alignment:
        """Align with the maps as seen from ``origins`` (B, 4, 4).

        ``hypotheses`` (B, K, 4, 4) are relative to those; ``thresholds`` (B,) are
        ``DeviceThresholds``.
        """

    def render(self, poses: Float64) -> ModelView:
        """The maps as seen from ``poses`` (B, 4, 4)."""


def measure_consistency(
    frames: Images, poses: Float64, wanted: Bool, aligner: FrameAligner, cutoff_m: float
) -> dict[int, AlignmentStatistics]:
    """How the frames of the envs ``wanted`` (B,) agree with the maps' views from ``poses``."""
    if not wanted.any():
        return {}
    view = aligner.render(np.where(wanted[:, None, None], poses, np.eye(4)))
    intensity, depth = view.intensity.numpy(), view.vertices.numpy()[..., 2]
    return {
        int(env): measure_photometric_consistency(
            frames.color[env], frames.depth[env], intensity[env], depth[env], cutoff_m
        )
        for env in np.flatnonzero(wanted)
    }


class Relocalization(Saved):
    """Where a lost frame of B envs is searched besides around the last good pose.

    This is the variant that searches nowhere else: "local".
    """

    def add_keyframes(self, frames: Images, poses: Float64, time: Int32, tracked: Bool) -> None:
        """Take note of the frames that were ``tracked`` (B,) at ``poses`` (B, 4, 4)."""

    def verify(self, frames: Images, poses: Float64, found: Bool, aligner: FrameAligner) -> Bool:
        """Which of the frames that were ``found`` (B,) again are really at ``poses`` (B, 4, 4)."""
        return found

    def relocalize(
        self, frames: Images, lost: Bool, aligner: FrameAligner
    ) -> tuple[Bool, Alignment] | None:
        """Search the maps for the frames of the envs that are ``lost`` (B,).

        Returns:
            Which of them were found (B,), and where; None if none was.
        """
        return None

    def propose(
        self, frames: Images, lost: Bool, attempts: Int32, aligner: FrameAligner
    ) -> Float64:
        """Poses (B, 4, 4) at which the envs that are ``lost`` (B,) may be; NaN: none.

        The map's view from there is like the frame; nothing has confirmed them yet. Every attempt
        (B,) looks elsewhere.
        """
        return np.full((len(lost), 4, 4), np.nan)

    def similar(self, env: int, frames: Images, before: int) -> list[Candidate]:
        """The best few keyframes from before a time that resemble an env's frame, best first."""
        return []

    def move_keyframes(self, env: int, time: Int32, poses: Float64) -> None:
        """Follow a map that was deformed: frames ``time`` (N,) were at ``poses`` (N, 4, 4)."""

    def adapt(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Expect frames of another size, and a map of readings up to another distance."""

    def clear(self, env: int) -> None:
        """Forget everything about one env."""

    def keyframe_poses(self, env: int) -> Float64:
        """Poses (K, 4, 4) of the keyframes of one env."""
        return np.zeros((0, 4, 4))

    def least_dissimilarity(self, env: int, frames: Images, keyframes: dict[str, Any]) -> float:
        """Of an env's frame and the one of some keyframes that resembles it most, in [0, 1].

        Infinity where there is none.
        """
        return np.inf

    def get_keyframes(self, env: int) -> dict[str, Any]:
        """The keyframes of one env, as arrays."""
        return {}

    def keyframes_like(self) -> dict[str, Any]:
        """What ``get_keyframes`` gives, as ``Stateful.state_like`` says it."""
        return {}

    def set_keyframes(self, env: int, keyframes: dict[str, Any]) -> None:
        """Know these keyframes of one env, and nothing else."""
