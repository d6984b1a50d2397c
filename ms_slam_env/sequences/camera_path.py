"""What every seeded way of a camera through a scene can do."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.base import Scene

Float64 = NDArray[np.float64]


class CameraPath(ABC):
    """A way of a camera through a scene: a frozen dataclass of how it is carried."""

    @abstractmethod
    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4).

        The same scene and seed give the same way.

        Raises:
            InputError: no free way, or one that the scene does not permit.
        """
