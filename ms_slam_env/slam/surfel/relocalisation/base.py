"""What the SLAM asks of relocalisation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.ferns import Candidate
from ms_slam_env.slam.surfel.tracking import Alignment
from ms_slam_env.slam.surfel.types import ModelView

Bool = NDArray[np.bool_]
Int32 = NDArray[np.int32]


@dataclass(frozen=True)
class Images:
    """Frames as sensed.

    Attributes:
        color: (B, H, W, 3) uint8.
        depth: (B, H, W) float32 metres; 0 = no reading.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]


class Searcher(Protocol):
    """What relocalisation may ask of the SLAM about the current frames."""

    def align_from(self, origins: Float64, seeds: Float64, limits: NDArray[np.void]) -> Alignment:
        """Align with the maps as seen from ``origins`` (B, 4, 4).

        ``seeds`` (B, K, 4, 4) are relative to those; ``limits`` (B,) are ``verdict.Limits``.
        """

    def render(self, poses: Float64) -> ModelView:
        """The maps as seen from ``poses`` (B, 4, 4)."""


class Relocalisation(ABC):
    """Where a lost frame is searched besides around the last good pose, for B envs."""

    @abstractmethod
    def remember(self, frames: Images, poses: Float64, time: Int32, tracked: Bool) -> None:
        """Take note of the frames that were ``tracked`` (B,) at ``poses`` (B, 4, 4)."""

    @abstractmethod
    def believes(self, frames: Images, poses: Float64, found: Bool, searcher: Searcher) -> Bool:
        """Which of the frames that were ``found`` (B,) again are really at ``poses`` (B, 4, 4)."""

    @abstractmethod
    def search(
        self, frames: Images, lost: Bool, searcher: Searcher
    ) -> tuple[Bool, Alignment] | None:
        """Search the maps for the frames of the envs that are ``lost`` (B,).

        Returns:
            Which of them were found (B,), and where; None if none was.
        """

    @abstractmethod
    def similar(self, env: int, frames: Images, before: int) -> list[Candidate]:
        """The best few keyframes from before a time that resemble an env's frame, best first."""

    @abstractmethod
    def move(self, env: int, time: Int32, poses: Float64) -> None:
        """Follow a map that was bent: frames ``time`` (N,) were taken at ``poses`` (N, 4, 4)."""

    @abstractmethod
    def adapt(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Expect frames of another size, and a map of readings up to another distance."""

    @abstractmethod
    def clear(self, env: int) -> None:
        """Forget everything about one env."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of the same variant, batch and camera."""
