"""Which object each point of a map was seen on, asked of the frames that made the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.geometry.point_clouds import check_points

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class LabelledView:
    """A frame that is part of a map, with what it really showed.

    Attributes:
        T_world_camera: (4, 4) where the camera truly was.
        T_world_camera_estimate: (4, 4) where SLAM put it.
        color: (H, W, 3) uint8.
        depth: (H, W) metres along the optical axis, 0 = nothing.
        labels: (H, W) int, the object that each pixel really shows; negative = none.
    """

    T_world_camera: Float64
    T_world_camera_estimate: Float64
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    labels: NDArray[np.integer]

    @property
    def T_true_map(self) -> Float64:
        """(4, 4) motion that takes what this frame put into the map to its true place."""
        return self.T_world_camera @ invert(self.T_world_camera_estimate)


@dataclass(frozen=True)
class SightingRule:
    """When a view sees a point of the map.

    Attributes:
        depth_slack_m: the view's depth agrees with the point's to this, at 1 m; grows with depth
            squared like the sensor's noise.
        color_slack: and its colour to this, in grey levels of the channel that differs most.
        range_m: nothing farther away is counted.
    """

    depth_slack_m: float = 0.02
    color_slack: float = 30.0
    range_m: float = 2.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "depth_slack_m", 1e-4, 1.0)
        check_range(self, "color_slack", 0.0, 255.0)
        check_range(self, "range_m", 0.1, 100.0)


def count_votes(
    points: ArrayLike,
    colors: ArrayLike,
    views: Sequence[LabelledView],
    intrinsics: Intrinsics,
    num_labels: int,
    rule: SightingRule | None = None,
) -> Int64:
    """How many views saw each point on each object, (N, num_labels).

    A view sees a point if the point, projected with the view's *estimated* pose, lies in the image
    at the depth and with the colour that the view has there; it votes for the object that the pixel
    *truly* shows. A point whose colour no view has, being a mixture of several, is judged by depth
    alone.

    Args:
        points: (N, 3) of the map, world frame.
        colors: (N, 3) of the points, 0 to 255.
        views: of the intrinsics' size.
        intrinsics: of the views.
        num_labels: labels are in [0, num_labels).
        rule: gives the slacks and the range.

    Raises:
        InputError: bad points, colours that do not fit them, views of another size, or a label out
            of range.
    """
    rule = rule or SightingRule()
    cloud, shades = check_points(points, "points"), np.asarray(colors, dtype=np.float64)
    if shades.shape != cloud.shape:
        raise InputError(f"colors must be {cloud.shape}, got {shades.shape}")
    by_depth = np.zeros((len(cloud), num_labels), dtype=np.int64)
    by_color = np.zeros_like(by_depth)
    for view in views:
        for name in ("color", "depth", "labels"):
            intrinsics.check_image(getattr(view, name), f"{name} of a view")
        if view.labels.max() >= num_labels:
            raise InputError(f"label {view.labels.max()} is outside [0, {num_labels})")
        index, pixel = _seen(cloud, view, intrinsics, rule)
        label = view.labels[pixel]
        by_depth[index, label] += 1
        alike = np.abs(shades[index] - view.color[pixel]).max(axis=1) <= rule.color_slack
        by_color[index[alike], label[alike]] += 1
    return np.where(by_color.any(axis=1, keepdims=True), by_color, by_depth)


def _seen(
    cloud: Float64, view: LabelledView, intrinsics: Intrinsics, rule: SightingRule
) -> tuple[Int64, tuple[Int64, Int64]]:
    """Points that the view has at their depth: indices (K,), rows and columns of their pixels."""
    camera = transform_points(invert(view.T_world_camera_estimate), cloud)
    index = np.flatnonzero((camera[:, 2] > 1e-3) & (camera[:, 2] <= rule.range_m))
    column, row = np.rint(intrinsics.project(camera[index])).T
    inside = (column >= 0) & (column < intrinsics.width)
    inside &= (row >= 0) & (row < intrinsics.height)
    index, row, column = index[inside], row[inside].astype(int), column[inside].astype(int)
    z, depth = camera[index, 2], view.depth[row, column]
    agrees = np.abs(depth - z) <= rule.depth_slack_m * np.maximum(1.0, z) ** 2
    agrees &= (depth > 0) & (view.labels[row, column] >= 0)
    return index[agrees], (row[agrees], column[agrees])


def distinct_placements(
    views: Sequence[LabelledView], points: ArrayLike, apart_m: float
) -> Float64:
    """Motions T_true_map (K, 4, 4) of the views, each unlike the ones before it.

    Two are alike if they place no corner of the box around ``points`` (N, 3) as far as
    ``apart_m`` apart. The first one is the identity: the map as it is.

    Raises:
        InputError: bad points.
    """
    cloud = check_points(points, "points")
    bounds = np.stack([cloud.min(axis=0), cloud.max(axis=0)])
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
    found = [np.eye(4)]
    placed = [corners]
    for view in views:
        moved = transform_points(view.T_true_map, corners)
        if all(np.linalg.norm(moved - other, axis=1).max() >= apart_m for other in placed):
            found.append(view.T_true_map)
            placed.append(moved)
    return np.stack(found)
