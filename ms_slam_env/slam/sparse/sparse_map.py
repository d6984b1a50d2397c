"""Sparse map: keyframes and the points that they see."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ms_slam_env._runtime.arrays import Float32, Float64, Int64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.slam.shared.alignment_measures import DepthImage
from ms_slam_env.slam.shared.feature_matching import thumbnail
from ms_slam_env.slam.shared.orb_features import Features, InverseDepth
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ArrayOf, Fields, ListOf, WholeNumber
from ms_slam_env.slam.sparse.patches import Templates, cut

_TRIED_FRAMES = 8  # frames after which a point that is rarely found again is dropped
_FOUND_SHARE = 0.25  # as in ORB-SLAM


@dataclass
class Keyframe:
    """An image stored in the map."""

    T_world_camera: Float64  # (4, 4) its pose; optimisation moves it
    known: bool  # whether the pose was given; then optimisation does not move it
    frame: int  # number of the frame
    features: Features  # N features
    point_ids: Int64  # (N,) id of the point that each shows; -1 = none
    color: NDArray[np.uint8]  # (H, W, 3) uint8
    intensity: Float32  # (H, W) float32 in [0, 255]
    depth: Float32  # (H, W) float32 metres; 0 = no reading
    thumbnail: Float32 = field(init=False)  # (D,) unit vector that summarises its appearance
    templates: Templates = field(init=False)  # the patch around each feature
    # (N, 2) change of inverse depth from pixel to pixel at each feature, 1/m.
    slopes: Float64 = field(init=False)

    def __post_init__(self) -> None:
        self.thumbnail = thumbnail(self.image())
        self.templates = cut(self.intensity, self.features.pixels)
        self.slopes = InverseDepth(self.depth).slope(self.features.pixels)

    def image(self) -> DepthImage:
        """The image that frames are compared with."""
        return DepthImage(self.depth, self.intensity)

    def seen_points(self) -> Int64:
        """Ids of the points it shows."""
        return self.point_ids[self.point_ids >= 0]


class SparseMap(Saved):
    """Keyframes, points, and which keyframe sees which point."""

    saved = ("positions", "descriptors", "hosts", "host_features", "alive", "_tried", "_found")
    also_saved = ("keyframes",)

    def __init__(self, intrinsics: Intrinsics) -> None:
        self.intrinsics = intrinsics
        self.keyframes: list[Keyframe] = []
        self.positions: Float64 = np.zeros((0, 3))
        self.descriptors: NDArray[np.uint64] = np.zeros((0, 4), dtype=np.uint64)
        self.hosts: Int64 = np.zeros(0, dtype=np.int64)  # the keyframe that created each point
        self.host_features: Int64 = np.zeros(0, dtype=np.int64)  # and its feature there
        self.alive: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self._tried: Int64 = np.zeros(0, dtype=np.int64)
        self._found: Int64 = np.zeros(0, dtype=np.int64)

    def add(self, keyframe: Keyframe) -> int:
        """Add a keyframe, and a new point for each feature with depth but no point."""
        index = len(self.keyframes)
        self.keyframes.append(keyframe)
        features = keyframe.features
        known = keyframe.point_ids >= 0
        self.descriptors[keyframe.point_ids[known]] = features.descriptors[known]  # the latest view
        new = np.flatnonzero((keyframe.point_ids < 0) & (features.inverse_depth > 0))
        keyframe.point_ids[new] = len(self.positions) + np.arange(len(new))
        points = features.points(self.intrinsics)[new]
        points = transform_points(keyframe.T_world_camera, points)
        self.positions = np.concatenate([self.positions, points])
        self.descriptors = np.concatenate([self.descriptors, features.descriptors[new]])
        self.hosts = np.concatenate([self.hosts, np.full(len(new), index)])
        self.host_features = np.concatenate([self.host_features, new])
        self.alive = np.concatenate([self.alive, np.ones(len(new), dtype=bool)])
        zeros = np.zeros(len(new), dtype=np.int64)
        self._tried = np.concatenate([self._tried, zeros])
        self._found = np.concatenate([self._found, zeros])
        return index

    def shared(self, point_ids: Int64, keyframes: Iterable[int]) -> Int64:
        """Count how many of the given points each keyframe sees."""
        wanted = np.zeros(len(self.positions) + 1, dtype=bool)  # the last stands for "none", -1
        wanted[point_ids] = True
        shown, lengths = self._shown(keyframes)
        sums = np.concatenate([[0], np.cumsum(wanted[shown])])
        ends = np.cumsum(lengths, dtype=np.int64)
        return np.asarray(sums[ends] - sums[ends - lengths], dtype=np.int64)

    def neighbours(self, keyframe: int, count: int, least: int = 15) -> list[int]:
        """Up to ``count`` keyframes that share most points with one, at least ``least`` each."""
        everyone = range(len(self.keyframes))
        counts = self.shared(self.keyframes[keyframe].seen_points(), everyone)
        return _most_shared(counts, keyframe, count, least)

    def neighbours_of_each(
        self, keyframes: Sequence[int], count: int, least: int = 15
    ) -> list[list[int]]:
        """``neighbours`` of many keyframes at once: one matrix product counts the shared points."""
        shown, lengths = self._shown(range(len(self.keyframes)))
        rows = np.repeat(np.arange(len(lengths)), lengths)[shown >= 0]
        shown = shown[shown >= 0]
        shape = len(self.keyframes), len(self.positions)
        sights = csr_array((np.ones(len(shown), dtype=np.int64), (rows, shown)), shape=shape)
        seen = sights.astype(bool).astype(np.int64)[list(keyframes)]
        counts = (sights @ seen.T).toarray()
        return [
            _most_shared(counts[:, n], keyframe, count, least)
            for n, keyframe in enumerate(keyframes)
        ]

    def _shown(self, keyframes: Iterable[int]) -> tuple[Int64, Int64]:
        """Concatenated point ids of the keyframes' features, and their number per keyframe."""
        ids = [self.keyframes[k].point_ids for k in keyframes]
        none = np.zeros(0, dtype=np.int64)
        return np.concatenate([none, *ids]), np.array([len(one) for one in ids], dtype=np.int64)

    def points_of(self, keyframes: Iterable[int]) -> Int64:
        """Sorted ids of the live points that the keyframes see."""
        wanted = np.zeros(len(self.positions), dtype=bool)
        for k in keyframes:
            wanted[self.keyframes[k].seen_points()] = True
        return np.flatnonzero(wanted & self.alive)

    def count_sightings(self, tried: Int64, found: Int64) -> None:
        """Count points that a frame should have shown, and did; drop those rarely found again."""
        self._tried[tried] += 1
        self._found[found] += 1
        often = self._tried[tried] >= _TRIED_FRAMES
        rare = self._found[tried] < _FOUND_SHARE * self._tried[tried]
        self.alive[tried[often & rare]] = False

    def move(self, poses: dict[int, Float64]) -> None:
        """Move keyframes to new poses, along with the points that each created."""
        motions = np.tile(np.eye(4), (len(self.keyframes), 1, 1))
        for k, pose in poses.items():
            motions[k] = pose @ invert(self.keyframes[k].T_world_camera)
            self.keyframes[k].T_world_camera = pose
        of_point = motions[self.hosts]
        turned = np.einsum("nij,nj->ni", of_point[:, :3, :3], self.positions)
        self.positions = turned + of_point[:, :3, 3]

    def merge(self, kept: Int64, dropped: Int64) -> None:
        """Merge each of the ``dropped`` points (M,) into the corresponding one of ``kept`` (M,)."""
        replacement = np.arange(len(self.positions) + 1)  # the last stays for "none", -1
        replacement[dropped] = kept
        replacement[-1] = -1
        self.alive[dropped] = False
        for keyframe in self.keyframes:
            keyframe.point_ids = replacement[keyframe.point_ids]

    def get_state(self) -> dict[str, Any]:
        """Everything, as arrays."""
        return super().get_state() | {"keyframes": [_save(one) for one in self.keyframes]}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        counts = ArrayOf(np.int64, ("points",), least=0)
        like = {
            "positions": ArrayOf(np.float64, ("points", 3)),
            "descriptors": ArrayOf(np.uint64, ("points", 4)),
            "hosts": replace(counts, index_of="keyframes"),
            "host_features": counts,
            "alive": ArrayOf(np.bool_, ("points",)),
            "tried": counts,
            "found": counts,
            "keyframes": ListOf(_keyframe_like(self.intrinsics.shape), "keyframes", "frame"),
        }
        return Fields(like, _why_no_map)

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        super().set_state(state)
        self.keyframes = [_restore(saved) for saved in state["keyframes"]]


def _most_shared(counts: Int64, keyframe: int, count: int, least: int) -> list[int]:
    """The keyframes with the largest counts, except the given one."""
    others = np.where(np.arange(len(counts)) == keyframe, 0, counts)
    order = np.argsort(-others, kind="stable")[:count]
    return [int(k) for k in order if others[k] >= least]


_OF_KEYFRAME = ("T_world_camera", "point_ids", "color", "intensity", "depth")
_OF_FEATURES = ("pixels", "inverse_depth", "descriptors", "scale")


def _save(keyframe: Keyframe) -> dict[str, Any]:
    saved: dict[str, Any] = {name: getattr(keyframe, name).copy() for name in _OF_KEYFRAME}
    saved |= {"known": keyframe.known, "frame": keyframe.frame}
    for name in _OF_FEATURES:
        saved[name] = getattr(keyframe.features, name).copy()
    return saved


def _keyframe_like(shape: tuple[int, int]) -> dict[str, Any]:
    """Template of a keyframe's state for an image of ``shape`` (H, W)."""
    return {
        "T_world_camera": np.eye(4),
        "point_ids": ArrayOf(np.int64, ("features",), least=-1, index_of="points"),
        "color": ArrayOf(np.uint8, (*shape, 3)),
        "intensity": ArrayOf(np.float32, shape),
        "depth": ArrayOf(np.float32, shape, least=0),
        "known": False,
        "frame": WholeNumber(index_of="frames"),
        "pixels": ArrayOf(np.float64, ("features", 2)),
        "inverse_depth": ArrayOf(np.float64, ("features",), least=0),
        "descriptors": ArrayOf(np.uint64, ("features", 4)),
        "scale": ArrayOf(np.float64, ("features",), least=0),
    }


def _why_no_map(state: dict[str, Any]) -> str:
    """What is inconsistent between a state's keyframes and points."""
    features = np.array([len(keyframe["pixels"]) for keyframe in state["keyframes"]], np.int64)
    if (state["host_features"] >= features[state["hosts"]]).any():
        return "has points of features that their keyframes do not have"
    return ""


def _restore(saved: dict[str, Any]) -> Keyframe:
    features = Features(**{name: saved[name].copy() for name in _OF_FEATURES})
    own = {name: saved[name].copy() for name in _OF_KEYFRAME}
    return Keyframe(known=saved["known"], frame=saved["frame"], features=features, **own)
