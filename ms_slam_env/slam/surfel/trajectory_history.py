"""The frame history of one env, with poses and anchors; maps set aside, moved and merged."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env.geometry import invert, relative_angle, transform_points
from ms_slam_env.slam.shared.rows import join
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ArrayOf, ListOf, OrNone, WholeNumber
from ms_slam_env.slam.slam_backend import Loop
from ms_slam_env.slam.surfel.map_deformation import Constraints, Deformation, no_constraints
from ms_slam_env.slam.surfel.surfel_map import SurfelMap

ANCHORS = 12  # points of the map that hold a frame's pose
KEPT_CONSTRAINTS = 1000  # newest relative constraints of loops
_CONSTRAINT_ARRAYS = ("sources", "source_times", "targets", "target_times")


@dataclass
class TrajectoryHistory(Saved):
    """Fused frames of one env and the loops that it closed."""

    frames: list[int] = field(default_factory=list)  # the frames fused
    # (4, 4) of each frame, moved by later loop closures.
    poses: list[Float64] = field(default_factory=list)
    # (ANCHORS, 3) map points that each frame saw, moved in the same way. A pose keeps its place
    # relative to them, because they are metres away and may be far older.
    anchors: list[Float64] = field(default_factory=list)
    anchor_times: list[Float64] = field(default_factory=list)  # (ANCHORS,) their creation times
    # relative constraints of the closed loops.
    joined: Constraints = field(default_factory=no_constraints)
    # frame of a loop that waits for confirmation; None without one.
    found: int | None = None
    # (4, 4) motion of the world around the camera that would have closed that loop.
    correction: Float64 = field(default_factory=lambda: np.eye(4))

    saved = ("frames", "poses", "anchors", "anchor_times", "found", "correction")

    @property
    def last(self) -> int:
        """The frame fused last; -1 if there is none."""
        return self.frames[-1] if self.frames else -1

    def record(self, surfel_map: SurfelMap, env: int, frame: int, pose: Float64) -> None:
        """Record a frame that was just fused."""
        points, times = _seen_now(surfel_map, env, frame)
        self.frames.append(frame)
        self.poses.append(pose.copy())
        self.anchors.append(points)
        self.anchor_times.append(times)

    def loop_at(self, pose: Float64, before: int) -> Loop:
        """The loop from a camera at ``pose`` (4, 4) to the nearest frame ``before`` another."""
        count = max(1, int(np.searchsorted(self.frames, before)))
        motions = invert(np.stack(self.poses[:count])) @ pose
        nearest = int(np.argmin([motion_size(T) for T in motions]))
        return Loop(self.frames[nearest], motions[nearest])

    def confirms(self, pose: Float64, corrected: Float64, agreement_m: float, memory: int) -> bool:
        """Whether the last loop found within ``memory`` frames had the same correction.

        An alignment that slides along a surface differs from frame to frame. If the corrections
        differ, this one waits to be confirmed.
        """
        is_recent = self.found is not None and self.last - self.found <= memory
        difference = motion_size(invert(self.correction @ pose) @ corrected)
        if is_recent and difference <= agreement_m:
            self.found = None
            return True
        self.found, self.correction = self.last, corrected @ invert(pose)
        return False

    def move(self, deformation: Deformation, joined: Constraints, pose: Float64) -> None:
        """Deform the history with the map; the last frame's pose becomes ``pose`` (4, 4)."""
        points = np.stack(self.anchors)
        times = np.stack(self.anchor_times)
        moved = deformation.points(points.reshape(-1, 3), times.ravel()).reshape(points.shape)
        self.poses = list(_rigid_motions(points, moved) @ np.stack(self.poses))
        self.poses[-1] = pose.copy()
        self.anchors = list(moved)
        newest = slice(-KEPT_CONSTRAINTS, None)
        self.joined = join([self.joined.moved_by(deformation), joined]).chosen(newest)

    def moved(self, T: Float64) -> TrajectoryHistory:
        """A copy with the world moved by ``T`` (4, 4)."""
        joined = self.joined
        sources, targets = (transform_points(T, p) for p in (joined.sources, joined.targets))
        return replace(
            self,
            poses=[T @ pose for pose in self.poses],
            anchors=[transform_points(T, points) for points in self.anchors],
            joined=replace(joined, sources=sources, targets=targets),
            found=None,
        )

    def merged(self, other: TrajectoryHistory) -> TrajectoryHistory:
        """This history merged with another of the same world, in temporal order."""
        order = np.argsort(self.frames + other.frames, kind="stable").tolist()
        both = TrajectoryHistory()
        for name in ("frames", "poses", "anchors", "anchor_times"):
            values = getattr(self, name) + getattr(other, name)
            setattr(both, name, [values[k] for k in order])
        newest = slice(-KEPT_CONSTRAINTS, None)
        both.joined = join([self.joined, other.joined]).chosen(newest)
        return both

    def path_m(self, frame: int) -> float:
        """Length of the path since a frame."""
        first = int(np.searchsorted(self.frames, frame))
        positions = np.array([pose[:3, 3] for pose in self.poses[first:]]).reshape(-1, 3)
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    def trajectory(self) -> tuple[Int32, Float64]:
        """Frames (N,) and their poses (N, 4, 4)."""
        return np.array(self.frames, dtype=np.int32), np.array(self.poses).reshape(-1, 4, 4)

    def get_state(self) -> dict[str, Any]:
        """The whole state, as NumPy arrays."""
        joined = {name: getattr(self.joined, name).copy() for name in _CONSTRAINT_ARRAYS}
        return super().get_state() | {"joined": joined}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        points, times = ArrayOf(np.float64, ("joined", 3)), ArrayOf(np.float64, ("joined",))
        return {
            "frames": ListOf(WholeNumber(index_of="frames"), "fused"),
            "poses": ListOf(np.eye(4), "fused"),
            "anchors": ListOf(np.zeros((ANCHORS, 3)), "fused"),
            "anchor_times": ListOf(np.zeros(ANCHORS), "fused"),
            "found": OrNone(WholeNumber(least=-1)),
            "correction": np.eye(4),
            "joined": {
                name: times if name.endswith("times") else points for name in _CONSTRAINT_ARRAYS
            },
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state of ``get_state``."""
        super().set_state(state)
        arrays = {name: state["joined"][name].copy() for name in _CONSTRAINT_ARRAYS}
        self.joined = Constraints(**arrays)


def motion_size(T: Float64) -> float:
    """Upper bound, metres, on how far a motion (4, 4) moves points about 1 m away."""
    return float(np.linalg.norm(T[:3, 3]) + relative_angle(np.eye(3), T[:3, :3]))


def _seen_now(surfel_map: SurfelMap, env: int, frame: int) -> tuple[Float64, Float64]:
    """Positions (ANCHORS, 3) of surfels that a frame updated or started, and their times."""
    surfels = surfel_map.surfels
    used = int(surfels.count.numpy()[env])
    slots = np.flatnonzero(surfels.seen[env, :used].numpy() == frame) if used else np.zeros(0, int)
    if not len(slots):
        return np.zeros((ANCHORS, 3)), np.zeros(ANCHORS)
    chosen = slots[np.linspace(0, len(slots) - 1, ANCHORS).astype(np.int64)]
    points = surfels.position[env].numpy()[chosen].astype(np.float64)
    return points, surfels.created[env].numpy()[chosen] + 0.5


def _rigid_motions(before: Float64, after: Float64) -> Float64:
    """Motions (N, 4, 4) that best map points ``before`` (N, K, 3) to ``after`` (Kabsch 1976)."""
    centre_before, centre_after = before.mean(axis=1), after.mean(axis=1)
    spread = np.swapaxes(after - centre_after[:, None], 1, 2) @ (before - centre_before[:, None])
    U, _, Vt = np.linalg.svd(spread)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    motions = np.tile(np.eye(4), (len(before), 1, 1))
    R: NDArray[np.float64] = U @ Vt
    motions[:, :3, :3] = R
    motions[:, :3, 3] = centre_after - np.einsum("nij,nj->ni", R, centre_before)
    return motions


_LEAST_COSINE = 0.7  # of the angle between the normals of two surfels of one surface
_SAME_M = 0.02  # largest distance between them along the normal


@dataclass
class DetachedMap(Saved):
    """A map without its SLAM: surfels, keyframes and history.

    Attributes:
        surfels: arrays (M, ...) by name, from ``SurfelMap.get_surfels``.
        keyframes: arrays by name, from ``Relocalization.get_keyframes``.
        history: of the frames; empty without loop closure.
        label: index of the submap.
        since: frame at which it was set aside.
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
        """A copy with the world moved by ``T`` (4, 4)."""
        surfels, keyframes = dict(self.surfels), dict(self.keyframes)
        position = surfels["position"].astype(np.float64)
        surfels["position"] = transform_points(T, position).astype(np.float32)
        surfels["normal"] = (surfels["normal"] @ T[:3, :3].T).astype(np.float32)
        if keyframes:
            keyframes["poses"] = T @ keyframes["poses"]
        return replace(self, surfels=surfels, keyframes=keyframes, history=self.history.moved(T))

    def resumed(self, frame: int) -> DetachedMap:
        """A copy as if no time had passed between setting it aside and ``frame``."""
        surfels = dict(self.surfels)
        surfels["seen"] = surfels["seen"] + np.int32(frame - self.since)
        return replace(self, surfels=surfels, since=frame)

    def merged(self, newer: DetachedMap, stable: float) -> DetachedMap:
        """This map merged with a newer one of the same world.

        Where both have the same surface, surfels of the newer one with a confidence below
        ``stable`` are dropped.
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
