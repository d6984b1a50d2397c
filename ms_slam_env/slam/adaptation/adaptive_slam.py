"""A surfel SLAM that changes its configuration and keeps its map."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame, rendered_size
from ms_slam_env.config import from_dict
from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import SlamConfiguration, merged, read_configuration
from ms_slam_env.slam.frame_selection import FrameFilter, SelectiveSlam
from ms_slam_env.slam.shared.state import Stateful
from ms_slam_env.slam.shared.state_check import Depending, WholeNumber
from ms_slam_env.slam.slam_backend import SlamBackend
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam

_NEVER = 1_000_000_000  # limit on consecutive dropped frames, so none


class Controller(Stateful):
    """Chooses a configuration before every frame, by index from fast to robust.

    Attributes:
        index: index of the configuration chosen last; before any frame, of the first one.
    """

    index: int

    @abstractmethod
    def reset(self) -> None:
        """Forget every frame."""

    @abstractmethod
    def choose(self, frame: RGBDFrame, is_lost: bool) -> int:
        """Index of the configuration to process ``frame`` with.

        Args:
            frame: the sensor's frame.
            is_lost: whether SLAM has not started or has lost track.
        """

    def use(self, index: int) -> None:
        """Use configuration ``index`` from the next frame on.

        Raises:
            InputError: this controller chooses by itself.
        """
        raise InputError("configurations are chosen from outside under adaptation 'agent' only")


MOST = 8
"""Most configurations to switch between: a running SLAM keeps the buffers of all."""


@dataclass(frozen=True)
class Level:
    """One configuration of a running surfel SLAM.

    Attributes:
        config: its parameters.
        image_size: (width, height) that frames are reduced to; None: as they come.
        keep_every: every n-th frame is processed.
    """

    config: SurfelConfig
    image_size: tuple[int, int] | None = None
    keep_every: int = 1


def as_configurations(given: Iterable[Any]) -> tuple[SlamConfiguration, ...]:
    """Convert files, mappings of ``SlamConfiguration``'s fields, or such objects to configurations.

    Raises:
        InputError: another type, a bad file or value, none at all or more than ``MOST``.
    """
    if isinstance(given, (str, Mapping)) or not isinstance(given, Iterable):
        raise InputError(f"configurations = {given!r} must be a list of files or mappings")
    configurations = tuple(_configuration(one, index) for index, one in enumerate(given))
    if len(configurations) > MOST:
        raise InputError(f"configurations has {len(configurations)} entries, more than {MOST}")
    return configurations


def _configuration(given: Any, index: int) -> SlamConfiguration:
    if isinstance(given, SlamConfiguration):
        return given
    if isinstance(given, (str, Path)):
        return read_configuration(given)
    if isinstance(given, Mapping):
        return from_dict(SlamConfiguration, given, f"configurations[{index}]")
    raise InputError(f"configurations[{index}] = {given!r} must be a file or a mapping")


def make_levels(
    configurations: Sequence[SlamConfiguration], backend: SlamBackend
) -> tuple[Level, ...]:
    """Make a backend's levels; options that a configuration omits keep the backend's values.

    ``threads`` is ignored, as it cannot change while SLAM runs. The backend tries all levels and is
    then restored, so unsupported ones are refused here, and all buffers are allocated in advance.

    Raises:
        InputError: the backend cannot change its configuration, or not to one of these while it
            runs.
    """
    if not isinstance(backend, SurfelSlam):
        raise InputError("only the SLAM backend 'surfel' changes its configuration while it runs")
    own, own_size = backend.config, backend.image_size
    levels = []
    for index, configuration in enumerate(configurations):
        where = f"configurations[{index}]"
        if configuration.slam != "surfel":
            raise InputError(f"{where}: slam = {configuration.slam!r} must be 'surfel'")
        params = dict(configuration.slam_config)
        if params.pop("device", backend.device) != backend.device:
            raise InputError(f"{where}: a running SLAM stays on device {backend.device!r}")
        size = configuration.image_size
        level = Level(
            config=from_dict(SurfelConfig, merged(asdict(own), params), where),
            image_size=None if size is None else rendered_size(size),
            keep_every=configuration.keep_every,
        )
        try:
            backend.reconfigure(level.config, level.image_size)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        finally:
            backend.reconfigure(own, own_size)
        levels.append(level)
    return tuple(levels)


def default_configurations(intrinsics: Intrinsics) -> tuple[SlamConfiguration, ...]:
    """Three configurations for a camera's images, from fast to robust.

    Images are halved if they are large enough. That is faster and, because every pyramid level is
    coarser, copes with larger motions. Chosen on validation seeds (``ms-slam experiment
    adaptation``). ``about.cost`` is the processor time of a processed frame at 160x120, relative to
    the last configuration: 6.1, 6.9 and 9.5 ms were measured on one core of a busy machine.
    """
    half = intrinsics.width // 2
    size = next((name for name, wh in XTION_SIZES.items() if wh[0] == half >= 160), None)
    fast: dict[str, Any] = {"iterations": [1, 1, 2], "points_per_level": 2000}
    robust: dict[str, Any] = {"iterations": [8, 10, 20], "points_per_level": 20_000}
    return (
        SlamConfiguration(slam_config=fast, image_size=size, keep_every=4, about={"cost": 0.65}),
        SlamConfiguration(image_size=size, keep_every=2, about={"cost": 0.73}),
        SlamConfiguration(slam_config=robust, image_size=size, about={"cost": 1.0}),
    )


class AdaptiveSlam(SelectiveSlam):
    """A backend whose controller chooses its configuration before every frame.

    A configuration that keeps one frame in n drops the others: their results have ``processed``
    False and a pose predicted at constant velocity (``SelectiveSlam``). The first frame and those
    while tracking is lost are always processed.

    Args:
        backend: a ``SurfelSlam``; nothing else may feed it frames.
        levels: its configurations from fast to robust (``make_levels``).
        controller: chooses among them.
        drops_frames: whether ``keep_every`` applies; if not, every frame is processed.
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

    # The level is activated before the backend restores arrays of its image size.
    saved: ClassVar[tuple[str, ...]] = tuple(
        sorted(SelectiveSlam.saved, key=lambda name: name != "_filter")
    )

    def state_like(self) -> Any:
        """See ``Stateful``; arrays have the image size of the active level."""
        likes: list[Any] = []
        for index in reversed(range(len(self.levels))):
            self._switch.put_in_force(index)
            likes.insert(0, super().state_like())
        self._switch.reset()

        def like(state: Any) -> Any:
            index = state["filter"]["index"] if _has_index(state) else 0
            return likes[index if index in range(len(likes)) else 0]

        return Depending(like)

    @property
    def level(self) -> int:
        """Index of the last processed frame's configuration; before any frame, of the first one."""
        return self._switch.index

    @property
    def levels(self) -> tuple[Level, ...]:
        """The configurations from fast to robust."""
        return self._switch.levels

    def use(self, index: int) -> None:
        """Use configuration ``index`` from the next frame on.

        Raises:
            InputError: no such index, or the controller chooses by itself.
        """
        self.controller.use(index)


def _has_index(state: Any) -> bool:
    """Whether a state contains the active level; if not, other checks report it."""
    chosen = state.get("filter") if isinstance(state, Mapping) else None
    return isinstance(chosen, Mapping) and isinstance(chosen.get("index"), int)


class _Switch(FrameFilter):
    """Activates the chosen level, and admits the frames that it keeps."""

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
        self.put_in_force(self._controller.index)

    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether the active level keeps this frame; ``forced`` means lost or not started."""
        self.put_in_force(self._controller.choose(frame, forced))
        return not self._drops_frames or dropped + 1 >= self.levels[self.index].keep_every

    def put_in_force(self, index: int) -> None:
        """Track with this level's configuration from now on."""
        self.index = index
        level = self.levels[index]
        self._backend.reconfigure(level.config, level.image_size)

    def get_state(self) -> dict[str, Any]:
        """The active level and the controller's state."""
        return {"index": self.index, "controller": self._controller.get_state()}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        index = WholeNumber(most=len(self.levels) - 1)
        return {"index": index, "controller": self._controller.state_like()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.put_in_force(state["index"])
        self._controller.set_state(state["controller"])
