"""The duplicate-object check: does a map of a rendered scene show an object twice?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Bool, Float64, Int64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_truth import SURFACE_SPACING_M
from ms_slam_env.geometry import check_pose, invert, transform_points
from ms_slam_env.geometry.point_clouds import check_points, voxel_firsts
from ms_slam_env.scenes.mesh_queries import sample_surface
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene


@dataclass(frozen=True)
class LabelledView:
    """A frame that is part of a map, with the true labels of its pixels.

    Attributes:
        T_world_camera: (4, 4) true pose.
        T_world_camera_estimate: (4, 4) pose estimated by SLAM.
        color: (H, W, 3) uint8.
        depth: (H, W) metres along the optical axis, 0 = no reading.
        labels: (H, W) int, the object that each pixel truly shows; negative = none.
    """

    T_world_camera: Float64
    T_world_camera_estimate: Float64
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    labels: NDArray[np.integer]

    @property
    def T_true_map(self) -> Float64:
        """(4, 4) motion that moves this frame's part of the map to its true place."""
        return self.T_world_camera @ invert(self.T_world_camera_estimate)


@dataclass(frozen=True)
class SightingRule(Checked):
    """Conditions under which a view sees a point of the map.

    Attributes:
        depth_slack_m: largest difference between the view's depth and the point's at 1 m; grows
            with depth squared, like the sensor noise.
        color_slack: largest difference of colour, in grey levels of the channel that differs most.
        range_m: points farther away are ignored.
    """

    depth_slack_m: float = bounded(0.02, 1e-4, 1.0)
    color_slack: float = bounded(30.0, 0.0, 255.0)
    range_m: float = bounded(2.0, 0.1, 100.0)


def count_votes(
    points: ArrayLike,
    colors: ArrayLike,
    views: Sequence[LabelledView],
    intrinsics: Intrinsics,
    num_labels: int,
    rule: SightingRule | None = None,
) -> Int64:
    """Number of views that saw each point on each object, (N, num_labels).

    A view sees a point if the point, projected with the view's *estimated* pose, lies in the image
    and matches the view's depth and colour there. The view then votes for the object that the pixel
    *truly* shows. A point whose colour matches no view, because it mixes several, is judged by
    depth alone.

    Args:
        points: (N, 3) map points, world frame.
        colors: (N, 3) their colours, 0 to 255.
        views: views with images of the intrinsics' size.
        intrinsics: intrinsics of the views.
        num_labels: labels are in [0, num_labels).
        rule: tolerances and range.

    Raises:
        InputError: bad points, colours of another number, views of another size, or a label out of
            range.
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
    """Points that match the view's depth: indices (K,), and rows and columns of their pixels."""
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
    """Distinct motions T_true_map (K, 4, 4) of the views.

    Two motions count as the same if they move every corner of the box around ``points`` (N, 3) to
    places less than ``apart_m`` apart. The first motion is the identity, which leaves the map
    unchanged.

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


_POINTS_TO_PLACE = 1500  # evenly picked points of an object, to find its best placement


@dataclass(frozen=True)
class ConsistencyRule(Checked):
    """Conditions under which an object counts as shown twice.

    Attributes:
        apart_m: a point farther than this from its object's true surface is off the surface.
        share: an object is shown twice if more than this share of its points is off the surface.
        min_points: an object with fewer points is too small to judge.
        support: a point belongs to an object if at least this share of its views vote for it.
    """

    apart_m: float = bounded(0.04, 1e-4, 10.0)
    share: float = bounded(0.1, 0.0, 1.0)
    min_points: int = bounded(100, 1, 1_000_000_000)
    support: float = bounded(0.3, 0.0, 1.0)


@dataclass(frozen=True)
class ObjectConsistency:
    """One object of the map.

    Attributes:
        label: label of the object.
        points: number of map points seen on it.
        apart_share: share of them off its true surface when the object as a whole is placed where
            it fits best.
        misplaced_share: share of them off its true surface where the map has it.
        duplicated: whether it counts as shown twice.
    """

    label: int
    points: int
    apart_share: float
    misplaced_share: float
    duplicated: bool


@dataclass(frozen=True)
class MapConsistency:
    """Verdict on a map.

    Attributes:
        objects: objects with enough points to judge, by label.
        apart: (N,) bool, the points that are second copies of an object's surface.
    """

    objects: tuple[ObjectConsistency, ...]
    apart: Bool

    @property
    def duplicated(self) -> tuple[ObjectConsistency, ...]:
        """The objects shown twice, worst first."""
        found = [item for item in self.objects if item.duplicated]
        return tuple(sorted(found, key=lambda item: -item.apart_share))

    @property
    def success(self) -> bool:
        """Whether no object is shown twice."""
        return not any(item.duplicated for item in self.objects)


def judge_consistency(
    points: ArrayLike,
    votes: ArrayLike,
    surface: ArrayLike,
    surface_labels: ArrayLike,
    rule: ConsistencyRule | None = None,
    placements: ArrayLike | None = None,
) -> MapConsistency:
    """Find the objects that a map shows twice.

    An object that is shown once, but shifted, is not a duplicate, since a viewer of the map cannot
    know its true place. Each object is therefore judged in the one of the ``placements`` that
    leaves the fewest of its points off its surface. No rigid motion reconciles two copies.

    Args:
        points: (N, 3) map points, world frame, evenly spread (one per voxel), so that a surface
            counts by its area.
        votes: (N, L) number of views that saw each point on each object, see
            :func:`count_votes`.
        surface: (M, 3) points of the true surface.
        surface_labels: (M,) object of each true point.
        rule: the thresholds.
        placements: (K, 4, 4) motions of an object as a whole; only the identity if None.

    Raises:
        InputError: arrays that do not fit together, bad points, or placements that are not rigid.
    """
    rule = rule or ConsistencyRule()
    cloud, truth = check_points(points, "points"), check_points(surface, "surface")
    counts, owner = np.asarray(votes), np.asarray(surface_labels)
    if counts.ndim != 2 or len(counts) != len(cloud):
        raise InputError(f"votes must be ({len(cloud)}, labels), got {counts.shape}")
    if owner.shape != (len(truth),):
        raise InputError(f"surface_labels must be ({len(truth)},), got {owner.shape}")
    motions = [] if placements is None else [check_pose(T, "placement") for T in placements]  # type: ignore[union-attr]
    seen_on = (counts > 0) & (counts >= rule.support * counts.sum(axis=1, keepdims=True))
    apart = np.zeros(len(cloud), dtype=bool)
    objects = []
    for label in np.flatnonzero(seen_on.any(axis=0)):
        index = np.flatnonzero(seen_on[:, label])
        true_points = truth[owner == label]
        if len(index) < rule.min_points or len(true_points) == 0:
            continue
        tree = cKDTree(true_points, balanced_tree=False, compact_nodes=False)
        far = _beyond(cloud[index], tree, rule.apart_m)
        misplaced = float(far.mean())
        if misplaced > rule.share:
            far = _best_placed(cloud[index], tree, rule.apart_m, motions, far)
        share = float(far.mean())
        apart[index[far]] = True
        objects.append(
            ObjectConsistency(int(label), len(index), share, misplaced, share > rule.share)
        )
    return MapConsistency(tuple(objects), apart)


def _best_placed(
    points: Float64, tree: cKDTree, distance_m: float, motions: list[Float64], as_it_is: Bool
) -> Bool:
    """Mask (N,) of points off the surface in the best placement; ``as_it_is`` if none is better."""
    some = points[np.unique(np.linspace(0, len(points) - 1, _POINTS_TO_PLACE).astype(int))]
    shares = [_beyond(transform_points(T, some), tree, distance_m).mean() for T in motions]
    if not shares:
        return as_it_is
    best = _beyond(transform_points(motions[int(np.argmin(shares))], points), tree, distance_m)
    return best if best.sum() < as_it_is.sum() else as_it_is


def _beyond(points: Float64, tree: cKDTree, distance_m: float) -> Bool:
    """Mask (N,) of the points farther than ``distance_m`` from all points of the tree."""
    # With a bound, the search stops early for distant points and returns infinity.
    return np.isinf(tree.query(points, distance_upper_bound=distance_m)[0])


MAP_VOXEL_M = 0.01


@dataclass(frozen=True)
class JudgedMap:
    """A map and the verdict on it.

    Attributes:
        points: (N, 3) judged map points, world frame.
        colors: (N, 3) uint8, their colours.
        consistency: the verdict.
        labels: names of the scene's objects.
    """

    points: Float64
    colors: NDArray[np.uint8]
    consistency: MapConsistency
    labels: tuple[str, ...]

    def name(self, item: ObjectConsistency) -> str:
        """Name of an object."""
        return self.labels[item.label]

    def verdict(self) -> dict[str, Any]:
        """Metrics: ``success``, ``objects`` (judged), ``worst_apart_share``, ``duplicated``."""
        found = self.consistency
        return {
            "success": found.success,
            "objects": len(found.objects),
            "worst_apart_share": max((o.apart_share for o in found.objects), default=math.nan),
            "duplicated": [
                {"object": self.name(item), "apart_share": item.apart_share}
                for item in found.duplicated
            ],
        }


def labelled_view(
    sensor: RGBDSensor, T_world_camera: Float64, T_world_camera_estimate: Float64
) -> LabelledView:
    """Labelled view from a true pose (4, 4) that SLAM placed at an estimated pose."""
    view = sensor.ground_truth(T_world_camera)
    return LabelledView(
        T_world_camera, T_world_camera_estimate, view.color, view.depth, view.labels
    )


def judge_map(
    map_points: ArrayLike,
    map_colors: ArrayLike,
    views: list[LabelledView],
    sensor: RGBDSensor,
    rule: ConsistencyRule | None = None,
) -> JudgedMap:
    """Judge a map, points (N, 3) with colours (N, 3), made from ``views`` of the sensor's scene.

    An empty map shows nothing twice.
    """
    rule = rule or ConsistencyRule()
    scene = sensor.scene
    labels = scene.mesh.labels
    if len(np.asarray(map_points)) == 0:
        nothing = MapConsistency((), np.zeros(0, dtype=bool))
        return JudgedMap(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), nothing, labels)
    kept = voxel_firsts(map_points, MAP_VOXEL_M)
    points, colors = np.asarray(map_points)[kept], np.asarray(map_colors)[kept]
    votes = count_votes(points, colors, views, sensor.intrinsics, len(labels))
    surface, owner = labelled_surface(scene.name, scene.seed)
    placements = distinct_placements(views, points, rule.apart_m / 2)
    verdict = judge_consistency(points, votes, surface, owner, rule, placements)
    return JudgedMap(points, colors, verdict, labels)


@lru_cache(maxsize=2)
def labelled_surface(scene: str, seed: int) -> tuple[Float64, NDArray[np.int32]]:
    """The whole surface of a scene: points (N, 3) and the object (N,) of each.

    Includes surface that ``Scene.surface_points`` leaves out as hidden, because cameras can see
    into narrow places that it considers closed, and the inner side of a seat.
    """
    mesh = get_scene(scene, seed).mesh
    points, face = sample_surface(mesh.vertices, mesh.faces, SURFACE_SPACING_M)
    return points, mesh.face_label[face]
