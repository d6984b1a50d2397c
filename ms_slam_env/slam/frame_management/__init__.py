"""Active frame management: which frames SLAM processes (Saeedi et al., ICRA 2017, section V-A).

::

    config = make_config("divergence", threshold=0.02)
    backend = config.manage(slam.make("surfel", intrinsics))   # a SlamBackend again
    backend.track(frame).processed
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ms_slam_env.config import from_dict
from ms_slam_env.slam.frame_management.base import FrameFilter
from ms_slam_env.slam.frame_management.budget import BudgetConfig
from ms_slam_env.slam.frame_management.change import ChangeConfig
from ms_slam_env.slam.frame_management.config import FrameManagementConfig
from ms_slam_env.slam.frame_management.divergence import DivergenceFilterConfig
from ms_slam_env.slam.frame_management.every_frame import EveryFrameConfig
from ms_slam_env.slam.frame_management.managed_slam import ManagedSlam
from ms_slam_env.slam.frame_management.regular import RegularConfig

FRAME_MANAGEMENTS: Mapping[str, type[FrameManagementConfig]] = {
    "none": EveryFrameConfig,
    "regular": RegularConfig,
    "divergence": DivergenceFilterConfig,
    "budget": BudgetConfig,
}
"""Name to configuration."""


def make_config(name: str, **options: Any) -> FrameManagementConfig:
    """The configuration ``name`` with its options, nested ones as mappings.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    family: Any = FrameManagementConfig  # abstract; the name says which variant it becomes
    return from_dict(family, {"name": name, **options}, "frame_management")


__all__ = [
    "FRAME_MANAGEMENTS",
    "BudgetConfig",
    "ChangeConfig",
    "DivergenceFilterConfig",
    "EveryFrameConfig",
    "FrameFilter",
    "FrameManagementConfig",
    "ManagedSlam",
    "RegularConfig",
    "make_config",
]
