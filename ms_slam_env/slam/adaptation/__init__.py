"""Run-time adaptation: switching configurations of a running SLAM.

Saeedi et al., ICRA 2017, section V-B.

::

    config = make_config("divergence", configurations=["fast.yaml", "robust.yaml"])
    backend = config.adapt(slam.make("surfel", intrinsics))   # a SlamBackend again
    backend.track(frame)
    backend.level                                             # index of the active configuration
"""

from __future__ import annotations

from typing import Any

from ms_slam_env.config import from_dict
from ms_slam_env.slam.adaptation.adaptive_slam import AdaptiveSlam, Level, default_configurations
from ms_slam_env.slam.adaptation.controllers import (
    AdaptationConfig,
    AgentConfig,
    DivergenceAdaptationConfig,
    NoAdaptationConfig,
    SwitchingConfig,
)


def make_config(name: str, **options: Any) -> AdaptationConfig:
    """Make the configuration ``name`` with its options, nested ones as mappings.

    Raises:
        InputError: an unknown name or option (the message lists the valid ones), or a bad value.
    """
    return from_dict(AdaptationConfig, {"name": name, **options}, "adaptation")  # type: ignore[type-abstract]


__all__ = [
    "AdaptationConfig",
    "AdaptiveSlam",
    "AgentConfig",
    "DivergenceAdaptationConfig",
    "Level",
    "NoAdaptationConfig",
    "SwitchingConfig",
    "default_configurations",
    "make_config",
]
