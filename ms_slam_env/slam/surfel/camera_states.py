"""What the surfel SLAM knows of its cameras between frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.acceptance import Alignment
from ms_slam_env.slam.surfel.photometry import next_photometry, same_exposure
from ms_slam_env.slam.surfel.pose_hypotheses import damped


@dataclass
class CameraStates(Saved):
    """What is known of the cameras of B envs, between frames."""

    poses: Float64  # (B, 4, 4) T_world_camera
    motions: Float64  # (B, 4, 4) of the last frame, which predict the next
    photometry: NDArray[Any]  # (B,) how the live grey values relate to the map's
    started: NDArray[np.bool_]  # (B,) whether a frame has been taken
    lost: NDArray[np.int32]  # (B,) frames since tracking was lost
    time: NDArray[np.int32]  # (B,) frames taken
    doubted: NDArray[np.int32]  # (B,) frames in a row whose pose is uncertain

    saved = ("poses", "motions", "photometry", "started", "lost", "time", "doubted")

    @classmethod
    def at_rest(cls, batch: int) -> CameraStates:
        """Cameras at the identity pose that have seen nothing."""
        identity = np.tile(np.eye(4), (batch, 1, 1))
        zeros = np.zeros(batch, dtype=np.int32)
        started = np.zeros(batch, dtype=bool)
        exposure, counts = same_exposure(batch), (zeros.copy() for _ in range(3))
        return cls(identity, identity.copy(), exposure, started, *counts)

    def reset(self, env: int, pose: ArrayLike) -> None:
        """Start one env anew at a pose (4, 4)."""
        self.poses[env] = pose
        self.motions[env] = np.eye(4)
        self.photometry[env] = same_exposure(1)[0]
        self.started[env] = False
        self.lost[env] = 0
        self.time[env] = 0
        self.doubted[env] = 0

    def accept(self, env: int, alignment: Alignment, least_scale: float) -> None:
        """Move on to where the frame was tracked."""
        self.poses[env] = alignment.T_world_live[env]
        # Across a gap the motion is not one frame's.
        motion = np.eye(4) if self.lost[env] else alignment.T_model_live[env]
        # What a degenerate view leaves open was predicted itself: let it die away.
        is_degenerate = alignment.statistics[env]["degenerate_directions"] > 0
        self.motions[env] = damped(motion) if is_degenerate else motion
        self.lost[env] = 0
        self.doubted[env] = self.doubted[env] + 1 if alignment.uncertain[env] else 0
        self.photometry[env] = next_photometry(
            self.photometry[env],
            alignment.photometry[env],
            float(alignment.statistics[env]["term_conflict"]),
            least_scale,
        )

    def hold(self, env: int) -> None:
        """Stay where the frame was not tracked."""
        self.motions[env] = np.eye(4)
        self.lost[env] += 1
        self.doubted[env] = 0
