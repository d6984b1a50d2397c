"""Loop closures by name."""

from __future__ import annotations

from collections.abc import Callable

from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.loops.base import LoopClosure, NoLoopClosure
from ms_slam_env.slam.surfel.loops.closure import DeformationLoopClosure
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

_MAKERS: dict[str, Callable[[SurfelMap, SurfelConfig, str], LoopClosure]] = {
    "none": lambda surfel_map, config, device: NoLoopClosure(surfel_map.batch),
    "deformation": DeformationLoopClosure,
}


def make_loop_closure(surfel_map: SurfelMap, config: SurfelConfig, device: str) -> LoopClosure:
    """The loop closure ``config.loop_closure`` for the maps in ``surfel_map``."""
    return _MAKERS[config.loop_closure](surfel_map, config, device)
