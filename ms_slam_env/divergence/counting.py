"""From images to normalised histograms of intensity and normals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.divergence import kernels
from ms_slam_env.divergence.config import DivergenceConfig
from ms_slam_env.divergence.sphere import TABLE_SIZE, WEIGHT_SCALE, WeightTable, weight_table
from ms_slam_env.errors import InputError

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Histograms:
    """Normalised histograms of B frames, one row per frame and window.

    Attributes:
        intensity: (B, W, K) float64, W spatial windows, K intensity bins, each row sums to 1.
        normals: (B, W, L) float64, L bins on the sphere, each row sums to 1.
    """

    intensity: Float64
    normals: Float64

    def __len__(self) -> int:
        """Return the number of frames B."""
        return len(self.intensity)

    def __getitem__(self, frame: int) -> Histograms:
        """Return the histograms of one frame as a batch of one."""
        picked = slice(frame, frame + 1 or None)
        return Histograms(self.intensity[picked], self.normals[picked])


@lru_cache(maxsize=32)
def grouping_matrix(bins: int, smoothing: float) -> Float64:
    """Matrix (256, bins) that smooths a histogram of grey levels and groups it into bins.

    The Parzen window of a level is a Gaussian cut at the ends of the range and normalised, so
    that every pixel keeps weight 1. Level g falls into bin floor(g bins / 256).
    """
    levels = np.arange(256)
    if smoothing > 0:
        window = np.exp(-0.5 * ((levels[:, None] - levels[None, :]) / smoothing) ** 2)
        window /= window.sum(axis=1, keepdims=True)
    else:
        window = np.eye(256)
    group = np.zeros((256, bins))
    group[levels, levels * bins // 256] = 1.0
    matrix = window @ group
    matrix.flags.writeable = False
    return matrix


def normalise(counts: Float64, pseudo_count: float) -> Float64:
    """Distributions (..., K) of counts (..., K), with ``pseudo_count`` added to every bin.

    Counts that are all zero give the uniform distribution: nothing is known.
    """
    padded = counts + pseudo_count
    return padded / padded.sum(axis=-1, keepdims=True)


class HistogramCounter:
    """Counts the pixels of batches of frames on one device."""

    def __init__(self, config: DivergenceConfig, intrinsics: Intrinsics, device: str) -> None:
        """Upload the weight table for ``config`` to ``device`` (``cpu`` or ``cuda``)."""
        self._config = config
        self._intrinsics = intrinsics
        self._device = device
        self._windows = config.windows if config.measure == "windowed-kl" else (1, 1)
        self._table: WeightTable = weight_table(config.inclinations, float(config.alpha_deg))
        self._starts: Any = wp.array(self._table.starts, dtype=wp.int32, device=device)
        self._bins: Any = wp.array(self._table.bins, dtype=wp.int32, device=device)
        self._weights: Any = wp.array(self._table.weights, dtype=wp.int32, device=device)
        self._counts: dict[int, tuple[Any, Any]] = {}  # batch size -> buffers, allocated once

    def histograms(self, intensity: Any, depth: Any, normals: Any | None = None) -> Histograms:
        """Histograms of B frames.

        Args:
            intensity: (B, h, w) float32 in [0, 255], NumPy or Warp.
            depth: (B, h, w) float32 metres, 0 = no reading, NumPy or Warp.
            normals: (B, h, w, 3) float32, 0 = none, of any other length than 0 (NumPy, or Warp
                vec3 of shape (B, h, w)); computed from depth if None.

        Raises:
            InputError: shapes that do not fit each other or the intrinsics.
        """
        intensity_wp = self._upload(intensity, wp.float32, "intensity")
        depth_wp = self._upload(depth, wp.float32, "depth")
        shape = intensity_wp.shape
        if depth_wp.shape != shape:
            raise InputError(f"depth {depth_wp.shape} and intensity {shape} differ in shape")
        if normals is None:
            normals_wp = wp.empty((1, 1, 1), dtype=wp.vec3, device=self._device)
        else:
            normals_wp = self._upload(normals, wp.vec3, "normals")
            if normals_wp.shape != shape:
                raise InputError(f"normals {normals_wp.shape} and intensity {shape} do not fit")
        return self._normalised(
            *self._count(intensity_wp, depth_wp, normals_wp, normals is not None)
        )

    def normals(self, depth: Any) -> NDArray[np.float32]:
        """Unit normals (B, h, w, 3) towards the camera of depth (B, h, w), 0 where none."""
        depth_wp = self._upload(depth, wp.float32, "depth")
        result = wp.empty(depth_wp.shape, dtype=wp.vec3, device=self._device)
        wp.launch(
            kernels.compute_normals,
            dim=depth_wp.shape,
            inputs=[depth_wp, *self._camera(), result],
            device=self._device,
        )
        return result.numpy()

    def _upload(self, array: Any, dtype: Any, name: str) -> Any:
        """Return ``array`` as a Warp array (B, h, w) on the device; no copy on the CPU."""
        if not isinstance(array, wp.array):
            type_is_vector = dtype is wp.vec3
            array = np.ascontiguousarray(array, dtype=np.float32)
            if array.ndim != (4 if type_is_vector else 3):
                raise InputError(f"{name} must have a leading batch axis, got {array.shape}")
            if type_is_vector and array.shape[3] != 3:
                raise InputError(f"{name} must be (B, h, w, 3), got {array.shape}")
            array = wp.array(array, dtype=dtype, device=self._device, copy=False)
        if array.shape[1:] != self._intrinsics.shape:
            raise InputError(
                f"{name} is {array.shape[2]}x{array.shape[1]} but the intrinsics say "
                f"{self._intrinsics.width}x{self._intrinsics.height}"
            )
        return array

    def _camera(self) -> list[Any]:
        """Kernel arguments from focal length to edge threshold."""
        camera, config = self._intrinsics, self._config
        return [
            wp.vec2(camera.fx, camera.fy),
            wp.vec2(camera.cx, camera.cy),
            config.normal_radius,
            config.edge_threshold,
        ]

    def _buffers(self, batch: int) -> tuple[Any, Any]:
        """Zeroed counters for ``batch`` frames."""
        if batch not in self._counts:
            windows = self._windows[0] * self._windows[1]
            self._counts[batch] = (
                wp.zeros((batch, windows * 256), dtype=wp.int32, device=self._device),
                wp.zeros(
                    (batch, windows * self._table.num_bins), dtype=wp.int32, device=self._device
                ),
            )
        else:
            for buffer in self._counts[batch]:
                buffer.zero_()
        return self._counts[batch]

    def _count(
        self, intensity: Any, depth: Any, normals: Any, use_normals: bool
    ) -> tuple[Float64, Float64]:
        """Counts (B, W, 256) of grey levels and (B, W, L) of normals."""
        batch = intensity.shape[0]
        intensity_counts, normal_counts = self._buffers(batch)
        wp.launch(
            kernels.count_frames,
            dim=intensity.shape,
            inputs=[
                intensity,
                depth,
                normals,
                int(use_normals),
                int(self._config.intensity_pixels == "with-depth"),
                *self._camera(),
                wp.vec2i(*self._windows),
                TABLE_SIZE,
                self._starts,
                self._bins,
                self._weights,
                self._table.num_bins,
                intensity_counts,
                normal_counts,
            ],
            device=self._device,
        )
        windows = self._windows[0] * self._windows[1]
        return (
            intensity_counts.numpy().reshape(batch, windows, 256).astype(np.float64),
            normal_counts.numpy().reshape(batch, windows, -1) / WEIGHT_SCALE,
        )

    def _normalised(self, levels: Float64, normals: Float64) -> Histograms:
        """Histograms of raw counts."""
        config = self._config
        grouped = levels @ grouping_matrix(config.bins, float(config.smoothing))
        return Histograms(
            intensity=normalise(grouped, config.pseudo_count),
            normals=normalise(normals, config.pseudo_count),
        )
