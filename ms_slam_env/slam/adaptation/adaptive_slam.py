"""A surfel SLAM that changes its configuration while its map lives on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.slam.adaptation.base import Controller
from ms_slam_env.slam.adaptation.levels import Level
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.frame_management import FrameFilter, ManagedSlam
from ms_slam_env.slam.surfel import SurfelSlam

_NEVER = 1_000_000_000  # frames in a row that are dropped at most


class AdaptiveSlam(ManagedSlam):
    """A backend whose controller chooses its configuration before every frame.

    A configuration that keeps one frame in n drops the others: their results have ``processed``
    False and a pose carried on at constant velocity (``ManagedSlam``). The first frame and those
    while tracking is lost are always processed.

    Args:
        backend: a ``SurfelSlam``; whoever holds it as well must not feed it frames.
        levels: its configurations from fast to robust (``make_levels``).
        controller: chooses among them.
        drops_frames: whether ``keep_every`` counts; where not, every frame is processed.
    """

    def __init__(
        self,
        backend: SlamBackend,
        levels: Sequence[Level],
        controller: Controller,
        drops_frames: bool = True,
    ) -> None:
        assert isinstance(backend, SurfelSlam)  # ``make_levels`` refuses all others
        self.controller = controller
        self._switch = _Switch(backend, levels, controller, drops_frames)
        super().__init__(backend, self._switch, max_skip=_NEVER)

    @property
    def level(self) -> int:
        """Index of the configuration of the last processed frame; of the first before any."""
        return self._switch.index

    @property
    def levels(self) -> tuple[Level, ...]:
        """The configurations from fast to robust."""
        return self._switch.levels

    def use(self, index: int) -> None:
        """Take configuration ``index`` from the next frame on.

        Raises:
            InputError: no such index, or a variant that chooses by itself.
        """
        self.controller.use(index)


class _Switch(FrameFilter):
    """Puts the chosen level in force, and admits the frames that it keeps."""

    def __init__(
        self,
        backend: SurfelSlam,
        levels: Sequence[Level],
        controller: Controller,
        drops_frames: bool,
    ) -> None:
        self._backend = backend
        self.levels = tuple(levels)
        self._controller = controller
        self._drops_frames = drops_frames
        self.index = controller.index

    def reset(self) -> None:
        """Forget every frame."""
        self._controller.reset()
        self.index = self._controller.index

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether the level in force keeps this frame; ``forced`` means lost or not started."""
        self._put_in_force(self._controller.choose(frame, forced))
        return not self._drops_frames or dropped + 1 >= self.levels[self.index].keep_every

    def _put_in_force(self, index: int) -> None:
        self.index = index
        level = self.levels[index]
        self._backend.reconfigure(level.config, level.image_size)

    def get_state(self) -> dict[str, Any]:
        """The level in force and the controller's."""
        return {"index": self.index, "controller": self._controller.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        self._put_in_force(state["index"])
        self._controller.set_state(state["controller"])
