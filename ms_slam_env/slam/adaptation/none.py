"""No adaptation: one configuration from the first frame to the last."""

from __future__ import annotations

from dataclasses import dataclass, field

from ms_slam_env.slam.adaptation.config import AdaptationConfig
from ms_slam_env.slam.base import SlamBackend


@dataclass(frozen=True)
class NoAdaptationConfig(AdaptationConfig):
    """The configuration stays as it is."""

    name: str = field(default="none", init=False)

    def adapt(self, backend: SlamBackend, drops_frames: bool = True) -> SlamBackend:
        """The backend as it is."""
        return backend
