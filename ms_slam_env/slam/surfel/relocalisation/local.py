"""Lost frames are searched around the last good pose only."""

from __future__ import annotations

from typing import Any

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.ferns import Candidate
from ms_slam_env.slam.surfel.relocalisation.base import (
    Bool,
    Images,
    Int32,
    Relocalisation,
    Searcher,
)
from ms_slam_env.slam.surfel.tracking import Alignment


class LocalSearch(Relocalisation):
    """Nothing besides what the SLAM does anyway."""

    def remember(self, frames: Images, poses: Float64, time: Int32, tracked: Bool) -> None:
        """Nothing to remember."""

    def believes(self, frames: Images, poses: Float64, found: Bool, searcher: Searcher) -> Bool:
        """All of them: the tracker's verdict is final."""
        return found

    def search(
        self, frames: Images, lost: Bool, searcher: Searcher
    ) -> tuple[Bool, Alignment] | None:
        """Nowhere else to search."""
        return None

    def similar(self, env: int, frames: Images, before: int) -> list[Candidate]:
        """No keyframes."""
        return []

    def move(self, env: int, time: Int32, poses: Float64) -> None:
        """Nothing to move."""

    def adapt(self, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """It asks for neither."""

    def clear(self, env: int) -> None:
        """Nothing to forget."""

    def get_state(self) -> dict[str, Any]:
        """Nothing to keep."""
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""
