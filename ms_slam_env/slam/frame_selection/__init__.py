"""Frame selection: which frames SLAM processes (Saeedi et al., ICRA 2017, section V-A).

::

    config = make_config("divergence", threshold=0.02)
    backend = config.manage(slam.make("surfel", intrinsics))   # a SlamBackend again
    backend.track(frame).processed
"""

from __future__ import annotations

from typing import Any

from ms_slam_env.config import from_dict, nested_options
from ms_slam_env.slam.frame_selection.budget import BudgetConfig
from ms_slam_env.slam.frame_selection.filters import (
    ChangeConfig,
    DivergenceFilterConfig,
    EveryFrameConfig,
    FrameSelectionConfig,
    RegularConfig,
)
from ms_slam_env.slam.frame_selection.selective_slam import FrameFilter, SelectiveSlam


def make_config(name: str, **options: Any) -> FrameSelectionConfig:
    """Make the configuration ``name`` with its options, nested ones as mappings.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    family: Any = FrameSelectionConfig  # abstract; the name says which variant it becomes
    return from_dict(family, {"name": name, **options}, "frame_management")


def parse_frame_selection(text: str) -> FrameSelectionConfig:
    """Parse ``NAME,option=value,...``; nested options as in ``change.width=40``.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    name, *parts = text.split(",")
    return make_config(name, **nested_options(parts))


__all__ = [
    "BudgetConfig",
    "ChangeConfig",
    "DivergenceFilterConfig",
    "EveryFrameConfig",
    "FrameFilter",
    "FrameSelectionConfig",
    "RegularConfig",
    "SelectiveSlam",
    "make_config",
    "parse_frame_selection",
]
