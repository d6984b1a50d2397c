"""What the SLAM asks of loop closure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.slam.ferns import Candidate
from ms_slam_env.slam.surfel.types import LiveFrame

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Bool = NDArray[np.bool_]


class SimilarViews(Protocol):
    """Finds keyframes that resemble the frame just tracked."""

    def __call__(self, env: int, before: int) -> list[Candidate]:
        """Those of one env that were taken before a frame, the most similar first."""


class LoopClosure(ABC):
    """Recognises places seen before and bends the maps of B envs so that they meet again."""

    @abstractmethod
    def reset(self, env: int) -> None:
        """Forget one env."""

    @abstractmethod
    def select(self, lost: Int32) -> bool:
        """Choose the surfels that the next frames are tracked against and fused into.

        Args:
            lost: (B,) frames since tracking was lost; 0 = tracked.

        Returns:
            Whether the choice changed.
        """

    @abstractmethod
    def record(self, poses: Float64, time: Int32, fused: Bool) -> None:
        """Take note of frames.

        Args:
            poses: (B, 4, 4) T_world_camera.
            time: (B,) numbers of the frames.
            fused: (B,) whether the frame was fused.
        """

    @abstractmethod
    def close(
        self, live: LiveFrame, poses: Float64, time: Int32, tracked: Bool, similar: SimilarViews
    ) -> Bool:
        """Look for loops after frames were fused and recorded; correct maps and ``poses`` in place.

        Args:
            live: the frames just fused.
            poses: (B, 4, 4) T_world_camera; those of closed loops are overwritten.
            time: (B,) numbers of the frames.
            tracked: (B,) whether the frame was tracked and fused.
            similar: finds the keyframes that resemble an env's frame.

        Returns:
            (B,) which envs closed a loop.
        """

    @abstractmethod
    def trajectory(self, env: int) -> tuple[Int32, Float64]:
        """Frames (N,) and poses (N, 4, 4) of the past as the closures since have bent them.

        Empty where no trajectory is kept.
        """

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""


class NoLoopClosure(LoopClosure):
    """Frames are tracked against everything in the map, old and new alike; nothing is bent."""

    def __init__(self, batch: int) -> None:
        """For ``batch`` envs."""
        self._never = np.zeros(batch, dtype=bool)

    def reset(self, env: int) -> None:
        """There is nothing to forget."""

    def select(self, lost: Int32) -> bool:
        """All surfels, always."""
        return False

    def record(self, poses: Float64, time: Int32, fused: Bool) -> None:
        """Nothing is kept."""

    def close(
        self, live: LiveFrame, poses: Float64, time: Int32, tracked: Bool, similar: SimilarViews
    ) -> Bool:
        """Never."""
        return self._never

    def trajectory(self, env: int) -> tuple[Int32, Float64]:
        """Nothing is kept: poses are final when they are returned."""
        return np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4))

    def get_state(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        """Nothing."""
