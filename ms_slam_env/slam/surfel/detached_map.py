"""The map of one camera as plain arrays: put aside, moved, and made one with another."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env.geometry import transform_points
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.trajectory_history import TrajectoryHistory

_LEAST_COSINE = 0.7  # of the normals of two surfels of one surface
_SAME_M = 0.02  # farthest apart that they lie along the normal


@dataclass
class DetachedMap(Saved):
    """What has been mapped: surfels, keyframes, history.

    Attributes:
        surfels: arrays (M, ...) by name, as ``SurfelMap.get_surfels`` gives them.
        keyframes: as ``Relocalization.get_keyframes`` gives them.
        history: of the frames; empty where no loops are closed.
        label: number of the submap.
        since: frame at which it was put aside.
    """

    surfels: dict[str, NDArray[Any]] = field(default_factory=dict)
    keyframes: dict[str, NDArray[Any]] = field(default_factory=dict)
    history: TrajectoryHistory = field(default_factory=TrajectoryHistory)
    label: int = 0
    since: int = 0

    saved: ClassVar[tuple[str, ...]] = ("surfels", "keyframes", "history", "label", "since")

    @property
    def living(self) -> NDArray[np.bool_]:
        """Which of the surfels (M,) are alive."""
        return self.surfels["confidence"] > 0

    def moved(self, T: Float64) -> DetachedMap:
        """The same with the world moved by ``T`` (4, 4)."""
        surfels, keyframes = dict(self.surfels), dict(self.keyframes)
        position = surfels["position"].astype(np.float64)
        surfels["position"] = transform_points(T, position).astype(np.float32)
        surfels["normal"] = (surfels["normal"] @ T[:3, :3].T).astype(np.float32)
        if keyframes:
            keyframes["poses"] = T @ keyframes["poses"]
        return replace(self, surfels=surfels, keyframes=keyframes, history=self.history.moved(T))

    def resumed(self, frame: int) -> DetachedMap:
        """The same as if no time had gone by from when it was put aside until ``frame``."""
        surfels = dict(self.surfels)
        surfels["seen"] = surfels["seen"] + np.int32(frame - self.since)
        return replace(self, surfels=surfels, since=frame)

    def merged(self, newer: DetachedMap, stable: float) -> DetachedMap:
        """This map and a newer one of the same world as one.

        Where both have the same surface, surfels of the newer one that are not ``stable`` (their
        confidence is less) are left out.
        """
        kept = newer.living & ~(self._has(newer) & (newer.surfels["confidence"] < stable))
        return replace(
            self,
            surfels={
                name: np.concatenate([own[self.living], newer.surfels[name][kept]])
                for name, own in self.surfels.items()
            },
            keyframes={
                name: np.concatenate([own, newer.keyframes[name]])
                for name, own in self.keyframes.items()
            },
            history=self.history.merged(newer.history),
        )

    def _has(self, other: DetachedMap) -> NDArray[np.bool_]:
        """Which surfels (M,) of another map lie on a surface of this one."""
        own = {name: self.surfels[name][self.living] for name in ("position", "normal", "radius")}
        if not len(own["radius"]):
            return np.zeros(len(other.living), dtype=bool)
        position = other.surfels["position"]
        reach = float(np.quantile(own["radius"], 0.9)) + _SAME_M
        tree = cKDTree(own["position"])
        _, nearest = tree.query(position, distance_upper_bound=reach)
        found = nearest < len(own["radius"])
        nearest = np.where(found, nearest, 0)
        normal = own["normal"][nearest]
        off = np.abs(((position - own["position"][nearest]) * normal).sum(axis=1))
        cosine = (other.surfels["normal"] * normal).sum(axis=1)
        same: NDArray[np.bool_] = found & (off < _SAME_M) & (cosine > _LEAST_COSINE)
        return same
