"""No frame management: every frame is processed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.frame_management.base import FrameFilter
from ms_slam_env.slam.frame_management.config import FrameManagementConfig


@dataclass(frozen=True)
class EveryFrameConfig(FrameManagementConfig):
    """Every frame is processed."""

    name: str = field(default="none", init=False)

    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter that admits everything."""
        return EveryFrame()

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """The backend as it is."""
        return backend


class EveryFrame(FrameFilter):
    """Admits every frame."""

    def reset(self) -> None:
        """Nothing to forget."""

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Yes."""
        return True

    def get_state(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""
