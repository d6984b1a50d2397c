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
from ms_slam_env.metrics.reconstruction import check_points

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class LabelledView:
    """A frame that is part of a map, with what it really showed.

    Attributes:
        T_world_camera: (4, 4) where the camera truly was.
        T_world_camera_estimate: (4, 4) where SLAM put it.
        depth: (H, W) metres along the optical axis, 0 = nothing.
        labels: (H, W) int, the object that each pixel really shows; negative = none.
    """

    T_world_camera: Float64
    T_world_camera_estimate: Float64
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
        range_m: nothing farther away is counted.
    """

    depth_slack_m: float = 0.02
    range_m: float = 2.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "depth_slack_m", 1e-4, 1.0)
        check_range(self, "range_m", 0.1, 100.0)


def count_votes(
    points: ArrayLike,
    views: Sequence[LabelledView],
    intrinsics: Intrinsics,
    num_labels: int,
    rule: SightingRule | None = None,
) -> Int64:
    """How many views saw each point on each object, (N, num_labels).

    A view sees a point if the point, projected with the view's *estimated* pose, lies in the image
    at the depth that the view has there; it votes for the object that the pixel *truly* shows.

    Args:
        points: (N, 3) of the map, world frame.
        views: of the intrinsics' size.
        intrinsics: of the views.
        num_labels: labels are in [0, num_labels).
        rule: gives the slack of depth and the range.

    Raises:
        InputError: bad points, views of another size, or a label out of range.
    """
    rule = rule or SightingRule()
    cloud = check_points(points, "points")
    votes = np.zeros((len(cloud), num_labels), dtype=np.int64)
    for view in views:
        intrinsics.check_image(view.depth, "depth of a view")
        intrinsics.check_image(view.labels, "labels of a view")
        if view.labels.max() >= num_labels:
            raise InputError(f"label {view.labels.max()} is outside [0, {num_labels})")
        camera = transform_points(invert(view.T_world_camera_estimate), cloud)
        seen = np.flatnonzero((camera[:, 2] > 1e-3) & (camera[:, 2] <= rule.range_m))
        column, row = np.rint(intrinsics.project(camera[seen])).T
        inside = (column >= 0) & (column < intrinsics.width)
        inside &= (row >= 0) & (row < intrinsics.height)
        seen = seen[inside]
        pixel = row[inside].astype(np.int64), column[inside].astype(np.int64)
        z, depth, label = camera[seen, 2], view.depth[pixel], view.labels[pixel]
        agrees = np.abs(depth - z) <= rule.depth_slack_m * np.maximum(1.0, z) ** 2
        agrees &= (depth > 0) & (label >= 0)
        votes[seen[agrees], label[agrees]] += 1
    return votes


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
