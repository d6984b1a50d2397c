"""From images to normalised histograms of intensity and normals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.divergence import kernels
from ms_slam_env.divergence.config import DivergenceConfig
from ms_slam_env.divergence.sphere import MAP_SIZE, bin_directions, bins_near
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import Float64

Int32 = NDArray[np.int32]


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

    def __init__(
        self, config: DivergenceConfig, intrinsics: Intrinsics, device: str = "cpu"
    ) -> None:
        """Prepare for frames of ``intrinsics`` on ``device`` (``cpu`` or ``cuda``)."""
        self.config = config
        self.intrinsics = intrinsics
        self._device = device
        rows, columns = config.windows if config.measure == "windowed-kl" else (1, 1)
        self._windows = rows * columns
        height, width = intrinsics.shape
        self._grid: list[Any] = [
            wp.array(index.astype(np.int32), dtype=wp.int32, device=device)
            for index in (
                np.arange(height) * rows // height * columns,
                np.arange(width) * columns // width,
            )
        ]
        reach_px = math.tan(math.radians(config.normal_reach_deg)) * intrinsics.fx
        self._radius = max(1, round(reach_px))
        self._grouping = grouping_matrix(config.bins, float(config.smoothing))
        directions = bin_directions(config.inclinations)
        near = bins_near(config.inclinations, float(config.alpha_deg))
        self._bins = len(directions)
        self._cos_alpha = math.cos(math.radians(config.alpha_deg))
        self._sphere: list[Any] = [
            wp.array(directions.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(near, dtype=wp.int32, device=device),
        ]
        self._buffers: dict[int, tuple[Any, Any, Any]] = {}  # by batch size

    def histograms(self, intensity: Any, depth: Any, normals: Any | None = None) -> Histograms:
        """Histograms of B frames, all counted in one pass.

        Args:
            intensity: (B, h, w) float32 in [0, 255], NumPy or Warp.
            depth: (B, h, w) float32 metres, 0 = no reading, NumPy or Warp.
            normals: (B, h, w, 3) float32, 0 = none, of any other length than 0 (NumPy, or Warp
                vec3 of shape (B, h, w)); computed from depth if None.

        Raises:
            InputError: shapes that do not fit each other or the intrinsics; NaN, infinite or
                negative depth in a NumPy array.
        """
        intensity_wp = self._upload(intensity, wp.float32, "intensity")
        depth_wp = self._upload(depth, wp.float32, "depth")
        if isinstance(depth, np.ndarray) and not (depth.min() >= 0 and depth.max() < np.inf):
            raise InputError("depth holds NaN, infinite or negative values; 0 means no reading")
        shape = intensity_wp.shape
        if depth_wp.shape != shape:
            raise InputError(f"depth {depth_wp.shape} and intensity {shape} differ in shape")
        if normals is None:
            counts = self._count(intensity_wp, depth_wp, None)
        else:
            normals_wp = self._upload(normals, wp.vec3, "normals")
            if normals_wp.shape != shape:
                raise InputError(f"normals {normals_wp.shape} and intensity {shape} do not fit")
            counts = self._count(intensity_wp, depth_wp, normals_wp)
        return self._normalised(*counts)

    def normals(self, depth: Any) -> NDArray[np.float32]:
        """Unit normals (B, h, w, 3) towards the camera from depth (B, h, w); 0 where none."""
        depth_wp = self._upload(depth, wp.float32, "depth")
        inverse = self._inverse(depth_wp, wp.empty_like(depth_wp))
        result = wp.empty(depth_wp.shape, dtype=wp.vec3, device=self._device)
        self._launch(kernels.compute_normals, [inverse, *self._camera(), result])
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
        array = array.contiguous()
        if array.shape[1:] != self.intrinsics.shape:
            raise InputError(
                f"{name} is {array.shape[2]}x{array.shape[1]} but the intrinsics say "
                f"{self.intrinsics.width}x{self.intrinsics.height}"
            )
        return array

    def _camera(self) -> list[Any]:
        """Kernel arguments from focal length to edge threshold."""
        camera, config = self.intrinsics, self.config
        return [
            wp.vec2(camera.fx, camera.fy),
            wp.vec2(camera.cx, camera.cy),
            self._radius,
            config.edge_threshold,
        ]

    def _buffer(self, batch: int) -> tuple[Any, Any, Any]:
        """Return counters of grey levels, sums by row, both zero, and room for inverse depth."""
        if batch not in self._buffers:
            levels_shape = (batch, self._windows * 256)
            sums_shape = (batch * self.intrinsics.height * self._windows * self._bins,)
            images_shape = (batch, *self.intrinsics.shape)
            self._buffers[batch] = (
                wp.zeros(levels_shape, dtype=wp.int32, device=self._device),
                wp.zeros(sums_shape, dtype=wp.float32, device=self._device),
                wp.empty(images_shape, dtype=wp.float32, device=self._device),
            )
        levels, sums, inverse = self._buffers[batch]
        levels.zero_()
        sums.zero_()
        return levels, sums, inverse

    def _inverse(self, depth: Any, out: Any) -> Any:
        """Inverse depth (B, h, w), written to ``out``."""
        self._launch(kernels.invert_depth, [depth, out])
        return out

    def _launch(self, kernel: Any, inputs: list[Any]) -> None:
        """Run a kernel with one thread per row of the images ``inputs[0]``."""
        wp.launch(kernel, dim=inputs[0].shape[:2], inputs=inputs, device=self._device)

    def _count(self, intensity: Any, depth: Any, normals: Any | None) -> tuple[Int32, Float64]:
        """Counts (B, W, 256) of grey levels and sums (B, W, L) of the weights of normals, (9)."""
        batch = intensity.shape[0]
        levels, sums, inverse = self._buffer(batch)
        only_with_depth = int(self.config.intensity_pixels == "with-depth")
        self._launch(
            kernels.count_intensity, [intensity, depth, only_with_depth, *self._grid, levels]
        )
        tail = [
            *self._grid,
            *self._sphere,
            MAP_SIZE,
            self._cos_alpha,
            self._windows * self._bins,
            sums,
        ]
        if normals is None:
            inverse = self._inverse(depth, inverse)
            self._launch(kernels.weigh_depth_normals, [inverse, *self._camera(), *tail])
        else:
            self._launch(kernels.weigh_given_normals, [normals, *tail])
        weights = sums.numpy().reshape(batch, self.intrinsics.height, -1).sum(
            axis=1, dtype=np.float64
        ) / (1 - self._cos_alpha)
        return (
            levels.numpy().reshape(batch, self._windows, 256),
            weights.reshape(batch, self._windows, self._bins),
        )

    def _normalised(self, levels: Int32, weights: Float64) -> Histograms:
        """Histograms of raw counts and of the sums of equation (9)."""
        pseudo_count = self.config.pseudo_count
        return Histograms(
            intensity=normalise(levels @ self._grouping, pseudo_count),
            normals=normalise(weights, pseudo_count),
        )
