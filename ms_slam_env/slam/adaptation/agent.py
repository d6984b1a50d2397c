"""The configuration is chosen from outside, such as by a trained agent."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.slam.adaptation.base import Controller
from ms_slam_env.slam.adaptation.config import SwitchingConfig


@dataclass(frozen=True)
class AgentConfig(SwitchingConfig):
    """``AdaptiveSlam.use(index)`` says which configuration is in force."""

    name: str = field(default="agent", init=False)

    def make_controller(self, intrinsics: Intrinsics) -> Controller:
        """The controller that is told."""
        return AgentController(self.num_configurations, self.first)


class AgentController(Controller):
    """Keeps to what it was told last."""

    def __init__(self, count: int, first: int) -> None:
        """Of ``count`` configurations, start with ``first``."""
        self._count, self._first = count, first
        self.reset()

    def reset(self) -> None:
        """Back to the first."""
        self.index = self._first

    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """The index told."""
        return self.index

    def use(self, index: int) -> None:
        """Take configuration ``index`` from the next frame on.

        Raises:
            InputError: there is none of that index.
        """
        if not 0 <= index < self._count:
            raise InputError(f"configuration {index!r} is outside [0, {self._count - 1}]")
        self.index = int(index)

    def get_state(self) -> dict[str, Any]:
        """The index."""
        return {"index": self.index}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on with the index of a state."""
        self.index = state["index"]
