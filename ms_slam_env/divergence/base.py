"""The interface of every divergence between frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.divergence.config import DivergenceConfig
from ms_slam_env.divergence.counting import HistogramCounter, Histograms

Float64 = NDArray[np.float64]


class Divergence(ABC):
    """Histograms of frames, and how far frames are apart in intensity and in depth."""

    def __init__(
        self, config: DivergenceConfig, intrinsics: Intrinsics, device: str = "cpu"
    ) -> None:
        """Prepare for images of ``intrinsics`` on ``device`` (``cpu`` or ``cuda``)."""
        self.config = config
        self.intrinsics = intrinsics
        self._counter = HistogramCounter(config, intrinsics, device)

    def histograms(self, intensity: Any, depth: Any, normals: Any | None = None) -> Histograms:
        """Histograms of B frames, all counted in one pass.

        Args:
            intensity: (B, h, w) float32 in [0, 255], NumPy or Warp.
            depth: (B, h, w) float32 metres, 0 = no reading, NumPy or Warp.
            normals: (B, h, w, 3) float32 (Warp: (B, h, w) vec3) in the camera frame, 0 = none;
                computed from depth if None.

        Raises:
            InputError: shapes that do not fit each other or the intrinsics.
        """
        return self._counter.histograms(intensity, depth, normals)

    def normals(self, depth: Any) -> NDArray[np.float32]:
        """Unit normals (B, h, w, 3) towards the camera from depth (B, h, w); 0 where none."""
        return self._counter.normals(depth)

    def divergence(self, current: Histograms, reference: Histograms) -> Float64:
        """Intensity and depth divergence (B, 2) of B frames from 1 or B reference frames."""
        return np.stack(
            [
                self.compare_intensity(current.intensity, reference.intensity),
                self.compare_normals(current.normals, reference.normals),
            ],
            axis=1,
        )

    @abstractmethod
    def compare_intensity(self, current: Float64, reference: Float64) -> Float64:
        """Intensity divergence (B,) of histograms (B, W, K) from (1 or B, W, K)."""

    @abstractmethod
    def compare_normals(self, current: Float64, reference: Float64) -> Float64:
        """Depth divergence (B,) of histograms of normals (B, W, L) from (1 or B, W, L)."""
