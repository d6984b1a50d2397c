"""Relocalisations by name."""

from __future__ import annotations

from ms_slam_env.camera import Intrinsics
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.relocalisation.base import Relocalisation
from ms_slam_env.slam.surfel.relocalisation.keyframes import FernRelocalisation
from ms_slam_env.slam.surfel.relocalisation.local import LocalSearch


def make_relocalisation(batch: int, intrinsics: Intrinsics, config: SurfelConfig) -> Relocalisation:
    """The relocalisation ``config.relocalisation`` for B envs with one camera model."""
    if config.relocalisation == "local":
        return LocalSearch()
    return FernRelocalisation(batch, intrinsics, config.depth_cutoff_m)
