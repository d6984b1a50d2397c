"""Does an object appear twice in a map? The paper's rule for a failed map, as a program.

Saeedi et al., ICRA 2017, section VI-C: "the consistency of the generated map was evaluated manually
as either a success or failure of SLAM. If duplicates of one object were present in the map, it was
considered as failure." Where the true surface of every object is known, what was seen on an object
either lies on its surface or is a second copy of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, transform_points
from ms_slam_env.geometry.point_clouds import check_points

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_POINTS_TO_PLACE = 1500  # of an object, evenly picked, decide where it fits best


@dataclass(frozen=True)
class ConsistencyRule:
    """When an object counts as present twice.

    Attributes:
        apart_m: a point this far from its object's true surface lies apart from it.
        share: an object is there twice if more than this share of its points lies apart.
        min_points: an object with fewer points is too small to judge.
        support: a point was seen on an object if at least this share of its views say so.
    """

    apart_m: float = 0.04
    share: float = 0.1
    min_points: int = 100
    support: float = 0.3

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "apart_m", 1e-4, 10.0)
        check_range(self, "share", 0.0, 1.0)
        check_range(self, "min_points", 1, 1_000_000_000)
        check_range(self, "support", 0.0, 1.0)


@dataclass(frozen=True)
class ObjectConsistency:
    """One object of the map.

    Attributes:
        label: of the object.
        points: of the map that were seen on it.
        apart_share: of them that lie apart from its true surface, the object being placed, as a
            whole, where it fits best.
        misplaced_share: of them that do where the map has it.
        duplicated: whether it counts as present twice.
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
        objects: those with enough points to judge, by label.
        apart: (N,) bool, the points that are second copies of what they were seen on.
    """

    objects: tuple[ObjectConsistency, ...]
    apart: Bool

    @property
    def duplicated(self) -> tuple[ObjectConsistency, ...]:
        """The objects that are there twice, the worst first."""
        found = [item for item in self.objects if item.duplicated]
        return tuple(sorted(found, key=lambda item: -item.apart_share))

    @property
    def success(self) -> bool:
        """Whether no object is there twice."""
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

    An object that the map shows once, but shifted, is no duplicate, and who looks at a map cannot
    know its true place: each object is judged in that one of the ``placements`` that leaves the
    fewest of its points apart from its surface. No motion of the whole reconciles two copies.

    Args:
        points: (N, 3) of the map, world frame, evenly spread (one a voxel), so that a surface
            counts by its area.
        votes: (N, L) how many views saw each point on each object, see
            :func:`ms_slam_env.metrics.sightings.count_votes`.
        surface: (M, 3) of the true surface.
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
    """Which points (N,) lie apart where the object fits best, or ``as_it_is`` if that is best."""
    some = points[np.unique(np.linspace(0, len(points) - 1, _POINTS_TO_PLACE).astype(int))]
    shares = [_beyond(transform_points(T, some), tree, distance_m).mean() for T in motions]
    if not shares:
        return as_it_is
    best = _beyond(transform_points(motions[int(np.argmin(shares))], points), tree, distance_m)
    return best if best.sum() < as_it_is.sum() else as_it_is


def _beyond(points: Float64, tree: cKDTree, distance_m: float) -> Bool:
    """Which points (N,) are farther than ``distance_m`` from all points of the tree."""
    # With a bound the search gives up early on points that are far away; those are at infinity.
    return np.isinf(tree.query(points, distance_upper_bound=distance_m)[0])
