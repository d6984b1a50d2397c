"""Information divergence between frames (Saeedi et al., ICRA 2017, section III)."""

from __future__ import annotations

from ms_slam_env.camera import Intrinsics, check_camera
from ms_slam_env.divergence.counting import Histograms
from ms_slam_env.divergence.divergence_config import MEASURES, DivergenceConfig
from ms_slam_env.divergence.measures import (
    Divergence,
    EarthMoversDivergence,
    KLDivergence,
    WindowedKLDivergence,
)
from ms_slam_env.divergence.pairwise import depth_divergence, intensity_divergence, ms_parameters
from ms_slam_env.errors import InputError

_VARIANTS: dict[str, type[Divergence]] = {
    "kl": KLDivergence,
    "windowed-kl": WindowedKLDivergence,
    "earth-movers": EarthMoversDivergence,
}


def make_divergence(
    config: DivergenceConfig, intrinsics: Intrinsics, device: str = "cpu"
) -> Divergence:
    """Make the divergence named by ``config.measure``, for images of ``intrinsics``."""
    check_camera(intrinsics)
    if not isinstance(config, DivergenceConfig):
        raise InputError(f"config must be a DivergenceConfig, got a {type(config).__name__}")
    return _VARIANTS[config.measure](config, intrinsics, device)


__all__ = [
    "MEASURES",
    "Divergence",
    "DivergenceConfig",
    "Histograms",
    "depth_divergence",
    "intensity_divergence",
    "make_divergence",
    "ms_parameters",
]
