"""Frame management as text: ``budget,share=0.5``."""

from __future__ import annotations

from ms_slam_env.config import nested_options
from ms_slam_env.slam.frame_selection import FrameSelectionConfig
from ms_slam_env.slam.frame_selection import make_config as make_frame_management


def parse_frame_management(text: str) -> FrameSelectionConfig:
    """The frame management ``NAME,option=value,...``; nested options as in ``change.width=40``.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    name, *parts = text.split(",")
    return make_frame_management(name, **nested_options(parts))
