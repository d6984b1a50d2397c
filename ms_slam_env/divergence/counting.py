"""Counts images into normalised histograms of intensity and normals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env._runtime.warp import HostDeviceBuffer, RecordedLaunch, wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.divergence import kernels
from ms_slam_env.divergence.divergence_config import DivergenceConfig
from ms_slam_env.divergence.sphere import MAP_SIZE, bin_directions, bins_near
from ms_slam_env.errors import InputError

_LARGEST_COPY = 1 << 18
"""Below this many bytes, copying an image is faster than wrapping it for Warp (20 microseconds)."""


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

    The Parzen window of a level is a Gaussian truncated at the ends of the range and normalised, so
    that every pixel has weight 1. Level g falls into bin floor(g bins / 256).
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
    """Normalise counts (..., K) to distributions, with ``pseudo_count`` added to every bin.

    All-zero counts give the uniform distribution.
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
        self._grouping = grouping_matrix(config.bins, float(config.smoothing))
        self._passes: dict[tuple[int, bool], _CountingPass] = {}  # by batch size, with normals

    def histograms(self, intensity: Any, depth: Any, normals: Any | None = None) -> Histograms:
        """Compute the histograms of B frames in one pass.

        Args:
            intensity: (B, h, w) grey values in [0, 255], NumPy or float32 Warp.
            depth: (B, h, w) metres, 0 = no reading, NumPy or float32 Warp.
            normals: (B, h, w, 3) of any length, 0 = none (NumPy, or Warp vec3 of shape (B, h, w));
                computed from depth if None.

        Raises:
            InputError: shapes that do not match each other or the intrinsics; NaN, infinite or
                negative depth in a NumPy array.
        """
        images = {"intensity": intensity, "depth": depth}
        images |= {} if normals is None else {"normals": normals}
        shape, *others = (self._checked_shape(image, name) for name, image in images.items())
        if isinstance(depth, np.ndarray) and not (depth.min() >= 0 and depth.max() < np.inf):
            raise InputError("depth holds NaN, infinite or negative values; 0 means no reading")
        if others[0] != shape:
            raise InputError(f"depth {others[0]} and intensity {shape} differ in shape")
        if others[-1] != shape:
            raise InputError(f"normals {others[-1]} and intensity {shape} do not fit")
        key = shape[0], normals is not None
        if key not in self._passes:
            self._passes[key] = _CountingPass(*key, self.config, self.intrinsics, self._device)
        return self._normalised(*self._passes[key](images))

    def normals(self, depth: Any) -> NDArray[np.float32]:
        """Unit normals (B, h, w, 3) facing the camera from depth (B, h, w); 0 = none."""
        shape = self._checked_shape(depth, "depth")
        source = _on_device(depth, wp.float32, self._device)
        inverse = wp.empty_like(source)
        result = wp.empty(shape, dtype=wp.vec3, device=self._device)
        camera = _camera_arguments(self.config, self.intrinsics)
        wp.launch(kernels.invert_depth, shape[:2], [source, inverse], device=self._device)
        inputs = [inverse, *camera, result]
        wp.launch(kernels.compute_normals, shape[:2], inputs, device=self._device)
        return result.numpy()

    def _checked_shape(self, array: Any, name: str) -> tuple[int, ...]:
        """Check that images match the intrinsics; return their shape (B, h, w)."""
        shape = tuple(array.shape) if isinstance(array, wp.array) else np.shape(array)
        if name == "normals" and not isinstance(array, wp.array):
            if len(shape) != 4 or shape[3] != 3:
                raise InputError(f"{name} must be (B, h, w, 3), got {shape}")
            shape = shape[:3]
        if len(shape) != 3:
            raise InputError(f"{name} must have a leading batch axis, got {shape}")
        if shape[1:] != self.intrinsics.shape:
            raise InputError(
                f"{name} is {shape[2]}x{shape[1]} but the intrinsics say "
                f"{self.intrinsics.width}x{self.intrinsics.height}"
            )
        return shape

    def _normalised(self, levels: Int32, weights: Float64) -> Histograms:
        """Make histograms from raw counts and the sums of equation (9)."""
        pseudo_count = self.config.pseudo_count
        return Histograms(
            intensity=normalise(levels @ self._grouping, pseudo_count),
            normals=normalise(weights, pseudo_count),
        )


class _CountingPass:
    """Recorded launches that count B frames, and their output arrays."""

    def __init__(
        self,
        batch: int,
        has_normals: bool,
        config: DivergenceConfig,
        intrinsics: Intrinsics,
        device: str,
    ) -> None:
        """Record the launches; normals are given if ``has_normals``, else computed from depth."""
        self._device = device
        height, width = shape = intrinsics.shape
        rows, columns = config.windows if config.measure == "windowed-kl" else (1, 1)
        directions = bin_directions(config.inclinations)
        self._shape = (batch, rows * columns, len(directions))
        self._cos_alpha = math.cos(math.radians(config.alpha_deg))
        window_rows = np.arange(height) * rows // height * columns
        windows = (window_rows, np.arange(width) * columns // width)
        grid: list[Any] = [wp.array(each, dtype=wp.int32, device=device) for each in windows]
        near = bins_near(config.inclinations, float(config.alpha_deg))
        sphere: list[Any] = [
            wp.array(directions.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(near, dtype=wp.int32, device=device),
        ]
        per_row = rows * columns * len(directions)
        self._levels = HostDeviceBuffer((batch, rows * columns * 256), wp.int32, device)
        self._sums = HostDeviceBuffer((batch * height * per_row,), wp.float32, device)
        # Small images are copied to buffers of the recorded launches; large ones are bound
        # directly.
        room = (1 if batch * height * width * 4 > _LARGEST_COPY else batch, *shape)
        dtypes = {"intensity": wp.float32, "depth": wp.float32}
        dtypes |= {"normals": wp.vec3} if has_normals else {}
        self._buffers = {
            name: HostDeviceBuffer(room, each, device) for name, each in dtypes.items()
        }
        image = {name: buffer.array for name, buffer in self._buffers.items()}
        weights = [*grid, *sphere, MAP_SIZE, self._cos_alpha, per_row, self._sums.array]
        only_with_depth = int(config.intensity_pixels == "with-depth")
        counted = [image["intensity"], image["depth"], only_with_depth, *grid, self._levels.array]
        stages: list[tuple[Any, list[Any]]] = [(kernels.count_intensity, counted)]
        if has_normals:
            stages.append((kernels.weigh_given_normals, [image["normals"], *weights]))
        else:
            inverse = wp.empty((batch, *shape), dtype=wp.float32, device=device)
            camera = _camera_arguments(config, intrinsics)
            stages.append((kernels.invert_depth, [image["depth"], inverse]))
            stages.append((kernels.weigh_depth_normals, [inverse, *camera, *weights]))
        dim = (batch, height)
        self._launches = [RecordedLaunch(kernel, dim, inputs, device) for kernel, inputs in stages]
        self._totals = HostDeviceBuffer((batch, per_row), wp.float64, device)
        added = [self._sums.array, height, self._totals.array]
        self._add = RecordedLaunch(kernels.add_rows, (batch, per_row), added, device)

    def __call__(self, images: Mapping[str, Any]) -> tuple[Int32, Float64]:
        """Return counts (B, W, 256) of grey levels and sums (B, W, L) of normal weights, (9)."""
        for name, image in images.items():
            self._take(name, image)
        self._levels.zero()
        self._sums.zero()
        for launch in self._launches:
            launch.launch()
        self._add.launch()
        batch, windows, bins = self._shape
        return (
            self._levels.look().reshape(batch, windows, 256),
            (self._totals.look() / (1 - self._cos_alpha)).reshape(batch, windows, bins),
        )

    def _take(self, name: str, image: Any) -> None:
        """Copy or bind an image for the launches."""
        buffer = self._buffers[name]
        array = buffer.array
        if not isinstance(image, wp.array) and array.shape == np.shape(image)[:3]:
            buffer.write(image)
        else:
            array = _on_device(image, array.dtype, self._device)
        for launch in self._launches:
            if launch.takes(name):
                launch.set_param(name, array)


def _camera_arguments(config: DivergenceConfig, intrinsics: Intrinsics) -> list[Any]:
    """Kernel arguments from focal length to edge threshold."""
    reach_px = math.tan(math.radians(config.normal_reach_deg)) * intrinsics.fx
    focal = wp.vec2(intrinsics.fx, intrinsics.fy)
    centre = wp.vec2(intrinsics.cx, intrinsics.cy)
    return [focal, centre, max(1, round(reach_px)), config.edge_threshold]


def _on_device(array: Any, dtype: Any, device: str) -> Any:
    """Convert to a contiguous Warp array, on the CPU without a copy if possible."""
    if not isinstance(array, wp.array):
        array = np.ascontiguousarray(array, dtype=np.float32)
        array = wp.array(array, dtype=dtype, device=device, copy=False)
    return array.contiguous()
