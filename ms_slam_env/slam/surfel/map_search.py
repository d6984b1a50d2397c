"""Where a camera is in maps that were put aside, and whether several looks agree on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.alignment_check import AlignmentStatistics
from ms_slam_env.slam.shared.map_fit import FitConfig, measure_fit, why_not_believed
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import Fields, ListOf, OrNone, WholeNumber
from ms_slam_env.slam.slam_backend import Float64, Views
from ms_slam_env.slam.surfel.acceptance import Alignment
from ms_slam_env.slam.surfel.detached_map import DetachedMap
from ms_slam_env.slam.surfel.pose_hypotheses import is_within, tracking_hypotheses
from ms_slam_env.slam.surfel.relocalization import Images, measure_consistency
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_config import SubmapConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.view_prediction import mean_pose

_FIT = FitConfig(queries=8)


class FrameLookup:
    """Looks for a frame in the map of a SLAM of one camera, which stays as it is."""

    def __init__(self, slam: BatchedSurfelSlam, frames: Images) -> None:
        """Look for ``frames`` (1, H, W) from now on; the SLAM's next frame ends that."""
        self._slam, self._frames = slam, frames
        slam.aligner.set_frame(slam.preprocess(frames.color, frames.depth))

    def align_near(self, pose: Float64) -> Alignment:
        """Align with the map as seen from ``pose`` (4, 4), under strict thresholds."""
        return self._slam.aligner.align_strictly(pose[None], tracking_hypotheses(np.eye(4))[None])

    def consistency(self, poses: Float64) -> AlignmentStatistics:
        """How the frame agrees with the map's view from ``poses`` (1, 4, 4)."""
        slam, wanted = self._slam, np.ones(1, dtype=bool)
        cutoff_m = slam.config.depth_cutoff_m
        return measure_consistency(self._frames, poses, wanted, slam.aligner, cutoff_m)[0]

    def verify(self, poses: Float64) -> bool:
        """Whether the map's view from ``poses`` (1, 4, 4) is like the frame."""
        slam, found = self._slam, np.ones(1, dtype=bool)
        return bool(slam.relocalization.verify(self._frames, poses, found, slam.aligner)[0])

    def propose(self, attempt: int) -> Float64 | None:
        """A pose (4, 4) where the frame may have been taken, from keyframes; None without."""
        slam, lost = self._slam, np.ones(1, dtype=bool)
        attempts = np.array([attempt], dtype=np.int32)
        poses = slam.relocalization.propose(self._frames, lost, attempts, slam.aligner)
        return poses[0] if np.isfinite(poses).all() else None


class MapFinder:
    """Finds frames in maps that were put aside; nothing is fused."""

    def __init__(self, slam: BatchedSurfelSlam) -> None:
        self._present = slam
        self._slam = BatchedSurfelSlam(1, slam.intrinsics, slam.config, slam.map.device)
        self._loaded: DetachedMap | None = None

    @property
    def map(self) -> SurfelMap:
        """The surfels of the map that was searched last."""
        return self._slam.map

    def keyframe_poses(self) -> Float64:
        """Poses (K, 4, 4) of its keyframes."""
        return self._slam.keyframe_poses()

    def forget(self) -> None:
        """Load a map anew next time."""
        self._loaded = None

    def dissimilarity(self, frames: Images, other: DetachedMap) -> float:
        """Of a frame and the keyframe of a map that resembles it most; infinity: it has none."""
        return self._present.relocalization.least_dissimilarity(0, frames, other.keyframes)

    def near(self, frames: Images, other: DetachedMap, pose: Float64) -> Float64 | None:
        """Where in a map a frame was taken if that is near ``pose`` (4, 4); None if it is not."""
        lookup = self._lookup(other, frames)
        found = lookup.align_near(pose)
        if not found.tracked[0] or not lookup.verify(found.T_world_live):
            return None
        return found.T_world_live[0]

    def anywhere(self, frames: Images, other: DetachedMap, attempt: int) -> Float64 | None:
        """Where in a map a frame was taken, from keyframes that resemble it; None if none does."""
        pose = self._lookup(other, frames).propose(attempt)
        return None if pose is None else self.near(frames, other, pose)

    def bears_out(self, slam: BatchedSurfelSlam, T_other_present: Float64, pose: Float64) -> bool:
        """Whether the views of the map found last and of ``slam``'s agree on how the maps lie.

        They are views from where cameras were, near ``pose`` (4, 4) in ``slam``'s map.
        """
        own = np.concatenate([slam.keyframe_poses(), pose[None]])
        present = MapViews.of(slam.map, own, pose)
        there = MapViews.of(self.map, self.keyframe_poses(), T_other_present @ pose)
        fit = measure_fit(there, present, T_other_present, _FIT)
        return not why_not_believed(fit, _FIT)

    def _lookup(self, other: DetachedMap, frames: Images) -> FrameLookup:
        self._slam.reconfigure(self._present.config, self._present.intrinsics)
        if self._loaded is not other:
            self._slam.attach_map(other)
            self._loaded = other
        return FrameLookup(self._slam, frames)


class JointSearch(Saved):
    """How the present map lies relative to one of those put aside: the looks that agree on it."""

    saved = ("_label", "_votes", "_frame", "_pose", "_looks")

    def __init__(self) -> None:
        self._label: int | None = None  # of the map put aside; None: nothing was found yet
        self._votes: list[Float64] = []  # (4, 4) T_other_present of each look
        self._frame: int | None = None  # of the last look
        self._pose = np.eye(4)  # (4, 4) in the present map at the last look
        self._looks = 0  # in vain, since the map was lost

    def state_like(self) -> Any:
        """See ``Stateful``."""
        like = {
            "label": OrNone(WholeNumber(most="submaps")),
            "votes": ListOf(np.eye(4)),
            "frame": OrNone(WholeNumber()),
        }
        return Fields(super().state_like() | like, _why_no_search)

    def is_due(self, frame: int, pose: Float64, rules: SubmapConfig) -> bool:
        """Whether it is time for a look; the next one that may agree is from another place."""
        if self._frame is None or frame - self._frame >= rules.interval:
            return True
        moved = not is_within(pose, self._pose, rules.step_m, np.radians(rules.step_deg))
        return self._label is not None and moved

    def look(
        self,
        frame: int,
        pose: Float64,
        frames: Images,
        detached: Sequence[DetachedMap],
        finder: MapFinder,
        rules: SubmapConfig,
    ) -> tuple[DetachedMap, Float64] | None:
        """Look for the camera at ``pose`` (4, 4) in the maps put aside.

        Returns:
            The map and T_other_present (4, 4), once enough looks agree.
        """
        self._frame, self._pose = frame, pose.copy()
        other, found = self._find(pose, frames, detached, finder, rules)
        if other is None or found is None:
            self._label, self._votes = None, []
            self._looks += 1
            return None
        T_other_present = found @ invert(pose)
        reach = rules.agreement_m, np.radians(rules.agreement_deg)
        if self._votes and not is_within(found, self._votes[0] @ pose, *reach):
            self._votes = []
        self._label = other.label
        self._votes.append(T_other_present)
        if len(self._votes) < rules.looks:
            return None
        mean = mean_pose(np.stack(self._votes) @ pose)
        self._label, self._votes = None, []
        return other, mean @ invert(pose)

    def _find(
        self,
        pose: Float64,
        frames: Images,
        detached: Sequence[DetachedMap],
        finder: MapFinder,
        rules: SubmapConfig,
    ) -> tuple[DetachedMap | None, Float64 | None]:
        expected = [each for each in detached if each.label == self._label]
        if expected:
            return expected[0], finder.near(frames, expected[0], self._votes[-1] @ pose)
        dissimilar = [finder.dissimilarity(frames, each) for each in detached]
        order = np.argsort(dissimilar, kind="stable")
        which = int(order[self._looks % len(order)])
        if dissimilar[which] > rules.dissimilarity:
            which = int(order[0])
        other = detached[which]
        found = finder.near(frames, other, pose)
        if found is None and dissimilar[which] <= rules.dissimilarity:
            found = finder.anywhere(frames, other, self._looks)
        return other, found


def _why_no_search(state: dict[str, Any]) -> str:
    """What is wrong between the label of a state and its votes."""
    is_known = state["label"] is not None
    return "" if is_known == bool(state["votes"]) else "has votes without a label, or a label alone"


@dataclass(frozen=True)
class MapViews:
    """A map and what it shows from where cameras were, in the place of their frames."""

    backend: SurfelMap
    frames: list[RGBDFrame]  # N
    estimates: Float64  # (N, 4, 4) T_map_camera
    tracked: NDArray[np.bool_]  # (N,) all of them

    @classmethod
    def of(cls, surfel_map: SurfelMap, poses: Float64, here: Float64) -> MapViews:
        """Views from those of the poses (K, 4, 4) that are nearest to one (4, 4)."""
        distance = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1)
        chosen = poses[np.argsort(distance, kind="stable")[: _FIT.queries]]
        frames = _as_frames(surfel_map.predict(chosen))
        return cls(surfel_map, frames, chosen, np.ones(len(chosen), dtype=bool))


def _as_frames(views: Views) -> list[RGBDFrame]:
    grey = np.rint(views.intensity).astype(np.uint8)[..., None].repeat(3, axis=-1)
    return [RGBDFrame(color, depth) for color, depth in zip(grey, views.depth, strict=True)]
