"""Divergence of one frame from another, and its maximum over a trajectory."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame, check_camera, intensity_image
from ms_slam_env.camera.frame import check_readings
from ms_slam_env.divergence.counting import HistogramCounter, grouping_matrix, normalise
from ms_slam_env.divergence.divergence_config import DivergenceConfig
from ms_slam_env.divergence.measures import kl_divergence
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import as_numbers

_PAPER = DivergenceConfig.paper()


def intensity_divergence(
    current: ArrayLike | RGBDFrame,
    previous: ArrayLike | RGBDFrame,
    *,
    bins: int = _PAPER.bins,
    pseudo_count: float = _PAPER.pseudo_count,
    smoothing: float = _PAPER.smoothing,
) -> float:
    """Intensity divergence KL(I_t || I_t-1) in nats, equation (5); the paper's setting by default.

    As printed, (5) sums from u = 0 to P, one term more than the P = 256 grey levels; here u < P.

    Args:
        current: I_t, an image (H, W) or (H, W, 3) uint8, or a frame.
        previous: I_t-1, likewise; its size may differ, since only distributions are compared.
        bins: P, number of equal bins of the 256 grey levels.
        pseudo_count: pixels added to every bin before normalising.
        smoothing: standard deviation of the Parzen window, grey levels; 0 = none.

    Raises:
        InputError: a wrong shape or type of image, an empty image, an option out of range.
    """
    config = DivergenceConfig(bins=bins, pseudo_count=pseudo_count, smoothing=smoothing)
    p, q = (_intensity_distribution(image, config) for image in (current, previous))
    return float(kl_divergence(p, q))


def depth_divergence(
    current: ArrayLike | RGBDFrame,
    previous: ArrayLike | RGBDFrame,
    intrinsics: Intrinsics,
    *,
    inclinations: int = _PAPER.inclinations,
    alpha_deg: float = _PAPER.alpha_deg,
    pseudo_count: float = _PAPER.pseudo_count,
    normal_reach_deg: float = _PAPER.normal_reach_deg,
    edge_threshold: float = _PAPER.edge_threshold,
) -> float:
    """Depth divergence KL(D_t || D_t-1) in nats, equations (6) to (10).

    Pixels without a reading have no normal and are left out. An image without any normal has the
    uniform distribution; two such images have divergence 0.

    Args:
        current: D_t, depth (H, W) in metres, 0 = no reading, or a frame.
        previous: D_t-1, likewise.
        intrinsics: intrinsics of both images.
        inclinations: N of equation (6).
        alpha_deg: influence angle alpha of equation (8), degrees.
        pseudo_count: normals added to every bin before normalising.
        normal_reach_deg: see ``DivergenceConfig``.
        edge_threshold: see ``DivergenceConfig``.

    Raises:
        InputError: NaN or negative depth, a size that differs from the intrinsics, an option out of
            range.
    """
    config = DivergenceConfig(
        inclinations=inclinations,
        alpha_deg=alpha_deg,
        pseudo_count=pseudo_count,
        normal_reach_deg=normal_reach_deg,
        edge_threshold=edge_threshold,
    )
    pair = np.stack([_depth_image(image, intrinsics) for image in (current, previous)])
    counter = _counter(config, intrinsics)
    histograms = counter.histograms(np.zeros_like(pair), pair).normals[:, 0]
    return float(kl_divergence(histograms[0], histograms[1]))


def ms_parameters(divergences: ArrayLike) -> tuple[float, float]:
    """Motion-and-structure parameters (M_I, M_D) of divergences (T, 2), equations (11), (12).

    Raises:
        InputError: a wrong shape, no rows, or values that are not finite and >= 0.
    """
    values = as_numbers(divergences, "divergences")
    if values.ndim != 2 or values.shape[1] != 2 or len(values) == 0:
        raise InputError(f"divergences must be (T, 2) with T >= 1, got {values.shape}")
    if not np.isfinite(values).all() or (values < 0).any():
        raise InputError("divergences must be finite and >= 0")
    M_I, M_D = values.max(axis=0)
    return float(M_I), float(M_D)


@lru_cache(maxsize=16)
def _counter(config: DivergenceConfig, intrinsics: Intrinsics) -> HistogramCounter:
    return HistogramCounter(config, intrinsics)


def _intensity_distribution(
    image: ArrayLike | RGBDFrame, config: DivergenceConfig
) -> NDArray[np.float64]:
    """Distribution (bins,) of the grey levels of one image."""
    grey = intensity_image(image.color if isinstance(image, RGBDFrame) else image)
    if grey.size == 0:
        raise InputError(f"an image must have pixels, got shape {grey.shape}")
    counts = np.bincount(grey.ravel(), minlength=256) @ grouping_matrix(
        config.bins, float(config.smoothing)
    )
    return normalise(counts, config.pseudo_count)


def _depth_image(image: ArrayLike | RGBDFrame, intrinsics: Intrinsics) -> NDArray[np.float32]:
    """Depth (H, W) float32 of one image, checked."""
    check_camera(intrinsics)
    try:
        depth = np.asarray(image.depth if isinstance(image, RGBDFrame) else image)
    except ValueError:  # rows of different lengths
        raise InputError("depth must be an array") from None
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise InputError(f"depth must be (H, W) float metres, got {depth.shape} {depth.dtype}")
    intrinsics.check_image(depth, "depth")
    check_readings(depth)
    return depth.astype(np.float32)
