"""What the configurations of frame management have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Family, check_choice, check_range
from ms_slam_env.slam.base import SlamBackend
from ms_slam_env.slam.frame_management.base import FrameFilter

PREDICTIONS = ("last", "constant-velocity")


@dataclass(frozen=True)
class FrameManagementConfig(Family):
    """Which frames SLAM processes: Saeedi et al., ICRA 2017, section V-A.

    Made from a mapping: ``from_dict(FrameManagementConfig, {"name": "divergence", ...})``.

    Attributes:
        name: of the variant.
    """

    name: str = field(default="", init=False)

    @classmethod
    def variants(cls) -> Mapping[str, type]:
        """The configurations by name."""
        from ms_slam_env.slam.frame_management import FRAME_MANAGEMENTS

        return FRAME_MANAGEMENTS

    @abstractmethod
    def make_filter(self, intrinsics: Intrinsics) -> FrameFilter:
        """The filter for frames of ``intrinsics``."""

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """``backend`` with this filter in front of it."""
        from ms_slam_env.slam.frame_management.managed_slam import ManagedSlam

        return ManagedSlam(backend, self.make_filter(backend.intrinsics))

    @property
    def uses_clock(self) -> bool:
        """Whether decisions depend on measured time, so that no two runs need be alike."""
        return False


@dataclass(frozen=True)
class DroppingConfig(FrameManagementConfig):
    """Of a filter that drops frames.

    Attributes:
        max_skip: most frames dropped in a row; it protects tracking.
        pose: of a dropped frame: ``constant-velocity``, the last pose moved on as between the
            last two processed frames, at most as far, or ``last``, the last processed frame's. A
            pose that the caller knows or guesses takes precedence.
    """

    max_skip: int = field(default=10, kw_only=True)
    pose: str = field(default="constant-velocity", kw_only=True)

    def __post_init__(self) -> None:
        """Refuse unknown choices and values out of range."""
        check_range(self, "max_skip", 0, 10_000)
        check_choice(self, "pose", PREDICTIONS)

    def manage(self, backend: SlamBackend) -> SlamBackend:
        """``backend`` with this filter in front of it."""
        from ms_slam_env.slam.frame_management.managed_slam import ManagedSlam

        made = self.make_filter(backend.intrinsics)
        return ManagedSlam(backend, made, self.max_skip, self.pose)
