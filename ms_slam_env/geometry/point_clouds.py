"""Point clouds: checks, voxel downsampling, alignment of corresponding points."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.geometry.pose import as_numbers

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def check_points(points: ArrayLike, name: str) -> Float64:
    """Return points (N, 3) as float64.

    Raises:
        InputError: wrong shape, no points, values that are not finite or not numbers.
    """
    values = as_numbers(points, name)
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{name} must be (N, 3), got {values.shape}")
    if len(values) == 0:
        raise InputError(f"{name} is empty")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds values that are not finite")
    return values


class IndexedCloud:
    """Points with their search trees, each built on first use.

    Functions that compare clouds accept it instead of an array, so that the trees are built once if
    many clouds are compared with the same one.

    Args:
        points: (N, 3).
        name: name of the points, for error messages.

    Raises:
        InputError: invalid points; it names them.
    """

    def __init__(self, points: ArrayLike, name: str = "points") -> None:
        self.points = check_points(points, name)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """The points."""
        return np.array(self.points, dtype, copy=copy)

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)

    @cached_property
    def tree(self) -> cKDTree:
        """SciPy's tree for nearest-neighbour search."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def gicp(self) -> tuple[Any, Any]:
        """small_gicp's points and tree."""
        import small_gicp

        cloud = small_gicp.PointCloud(self.points)
        return cloud, small_gicp.KdTree(cloud)


def indexed(points: ArrayLike | IndexedCloud, name: str) -> IndexedCloud:
    """Wrap points (N, 3) with search trees, unless they already have them.

    Raises:
        InputError: invalid points; it names them.
    """
    return points if isinstance(points, IndexedCloud) else IndexedCloud(points, name)


ASKEW = np.array([0.618, 0.382, 0.754])
"""Origin of a voxel grid, in voxels, that puts no plane at a round coordinate on a border.

There, rounding alone decides on which side of the border a point lies, and the plane gets a point
in both layers of voxels.
"""


def voxel_downsample(points: ArrayLike, voxel_m: float, origin: ArrayLike | None = None) -> Float64:
    """Keep the first point, in the given order, of each occupied voxel of side ``voxel_m``.

    ``origin`` (3,) is a corner of the voxels, in voxels, (0, 0, 0) by default; see `ASKEW`.

    Raises:
        InputError: invalid points, or a voxel size that is not positive.
    """
    values = check_points(points, "points")
    placed = values if origin is None else values - voxel_m * np.asarray(origin)
    return values[voxel_firsts(placed, voxel_m)]


def voxel_firsts(points: ArrayLike, voxel_m: float) -> NDArray[np.int64]:
    """Indices (K,), ascending, of the first point in each occupied voxel of side ``voxel_m``.

    Raises:
        InputError: invalid points, or a voxel size that is not positive.
    """
    values = check_points(points, "points")
    if not voxel_m > 0:
        raise InputError(f"voxel_m must be > 0, got {voxel_m}")
    index = np.floor(values / voxel_m).astype(np.int64)
    index -= index.min(axis=0)
    size = index.max(axis=0) + 1
    key = (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
    return np.sort(_firsts(key, math.prod(map(int, size))))


def _firsts(keys: NDArray[np.int64], below: int) -> NDArray[np.int64]:
    """Index (K,) of the first occurrence of each of the keys (N,), which are in [0, below).

    Key and index are sorted as one number, four times as fast as a stable sort of indices by key.
    """
    if below * len(keys) >= 2**63:
        return np.asarray(np.unique(keys, return_index=True)[1])
    ordered = np.sort(keys * len(keys) + np.arange(len(keys)))
    sorted_keys, indices = np.divmod(ordered, len(keys))
    return np.asarray(indices[np.diff(sorted_keys, prepend=-1) > 0])


def umeyama(
    source: Float64, target: Float64, with_scale: bool = False
) -> tuple[Float64, Float64, float]:
    """Rotation R (3, 3), translation t (3,) and scale s minimising |s R source + t - target|^2.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 1991, equations (38) to (43). Points (N, 3) of each set correspond by row. For
    degenerate sets (fewer than 3 points, or all on a line) it returns one of several optima.

    Raises:
        InputError: ``with_scale``, and all source points coincide.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_centred, target_centred = source - source_mean, target - target_mean
    covariance = target_centred.T @ source_centred / len(source)  # (38)
    U, singular, Vt = np.linalg.svd(covariance)
    S = np.eye(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        S[2, 2] = -1.0  # (43): the best proper rotation, not a reflection
    R = U @ S @ Vt  # (40)
    scale = 1.0
    if with_scale:
        variance = (source_centred**2).sum() / len(source)
        if variance < 1e-18:
            raise InputError("an alignment with scale needs an estimate that moves")
        scale = float((singular * np.diag(S)).sum() / variance)  # (42)
    return R, target_mean - scale * R @ source_mean, scale  # (41)


def umeyama_scales(sources: Float64, targets: Float64) -> Float64:
    """Scales (B,) of `umeyama` for B pairs of sets (B, N, 3), bit for bit.

    The points of a source must not all coincide.
    """
    centred, targets = (
        points - points.mean(axis=1, keepdims=True) for points in (sources, targets)
    )
    U, singular, Vt = np.linalg.svd(np.swapaxes(targets, 1, 2) @ centred / sources.shape[1])
    signs = np.ones_like(singular)
    signs[:, 2] = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)
    squares = (centred**2).reshape(len(sources), 3 * sources.shape[1])
    variance = squares.sum(axis=1) / sources.shape[1]
    return np.asarray((singular * signs).sum(axis=1) / variance)
