"""Submaps of the surfel SLAM of one camera: start one when lost, find older ones, join them.

The idea of ORB-SLAM's Atlas (Elvira, Tardós and Montiel, IROS 2019). After a few refused frames the
map is set aside, and a new one starts at the best guess of the camera's pose. Every few frames, the
camera is then searched for in the maps set aside: near its expected pose, and at similar keyframes.
When several searches from different places agree on the relative pose of the maps, and the views of
both maps agree there, the newer map is moved onto the older one and the two are merged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.geometry import invert, se3_exp, se3_log
from ms_slam_env.slam.shared.alignment_check import AlignmentStatistics
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.map_fit import FitConfig, measure_fit, why_not_believed
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import Fields, ListOf, OrNone, WholeNumber
from ms_slam_env.slam.shared.submap_frames import SubmapLedger, Submaps
from ms_slam_env.slam.slam_backend import TrackResult, Views
from ms_slam_env.slam.surfel.acceptance import Alignment
from ms_slam_env.slam.surfel.keyframe_search import measure_consistency
from ms_slam_env.slam.surfel.pose_hypotheses import is_within, tracking_hypotheses
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_config import SubmapConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.trajectory_history import DetachedMap, TrajectoryHistory
from ms_slam_env.slam.surfel.view_prediction import mean_pose

_FIT = FitConfig(queries=8)


class FrameLookup:
    """Looks for a frame in the map of a SLAM of one camera, without changing the map."""

    def __init__(self, slam: BatchedSurfelSlam, frames: Images) -> None:
        """Look for ``frames`` (1, H, W); valid until the SLAM's next frame."""
        self._slam, self._frames = slam, frames
        slam.aligner.set_frame(slam.preprocess(frames.color, frames.depth))

    def align_near(self, pose: Float64) -> Alignment:
        """Align with the map's view from ``pose`` (4, 4), under strict thresholds."""
        return self._slam.aligner.align_strictly(pose[None], tracking_hypotheses(np.eye(4))[None])

    def consistency(self, poses: Float64) -> AlignmentStatistics:
        """Statistics of the frame's agreement with the map's view from ``poses`` (1, 4, 4)."""
        slam, wanted = self._slam, np.ones(1, dtype=bool)
        cutoff_m = slam.config.depth_cutoff_m
        return measure_consistency(self._frames, poses, wanted, slam.aligner, cutoff_m)[0]

    def verify(self, poses: Float64) -> bool:
        """Whether the map's view from ``poses`` (1, 4, 4) agrees with the frame."""
        slam, found = self._slam, np.ones(1, dtype=bool)
        return bool(slam.relocalization.verify(self._frames, poses, found, slam.aligner)[0])

    def propose(self, attempt: int) -> Float64 | None:
        """A candidate pose (4, 4) of the frame, from keyframes; None if there is none."""
        slam, lost = self._slam, np.ones(1, dtype=bool)
        attempts = np.array([attempt], dtype=np.int32)
        poses = slam.relocalization.propose(self._frames, lost, attempts, slam.aligner)
        return poses[0] if np.isfinite(poses).all() else None


class MapFinder:
    """Finds frames in maps that were set aside; fuses nothing."""

    def __init__(self, slam: BatchedSurfelSlam) -> None:
        self._present = slam
        self._slam = BatchedSurfelSlam(1, slam.intrinsics, slam.config, slam.map.device)
        self._loaded: DetachedMap | None = None

    @property
    def map(self) -> SurfelMap:
        """The surfels of the map searched last."""
        return self._slam.map

    def keyframe_poses(self) -> Float64:
        """Poses (K, 4, 4) of its keyframes."""
        return self._slam.keyframe_poses()

    def forget(self) -> None:
        """Reload the map at the next search."""
        self._loaded = None

    def dissimilarity(self, frames: Images, other: DetachedMap) -> float:
        """Dissimilarity of a frame and a map's most similar keyframe; infinity without any."""
        return self._present.relocalization.least_dissimilarity(0, frames, other.keyframes)

    def near(self, frames: Images, other: DetachedMap, pose: Float64) -> Float64 | None:
        """Pose of a frame in a map, found near ``pose`` (4, 4); None if it is not there."""
        lookup = self._lookup(other, frames)
        found = lookup.align_near(pose)
        if not found.tracked[0] or not lookup.verify(found.T_world_live):
            return None
        return found.T_world_live[0]

    def anywhere(self, frames: Images, other: DetachedMap, attempt: int) -> Float64 | None:
        """Pose of a frame in a map, found from similar keyframes; None if it is not found."""
        pose = self._lookup(other, frames).propose(attempt)
        return None if pose is None else self.near(frames, other, pose)

    def bears_out(self, slam: BatchedSurfelSlam, T_other_present: Float64, pose: Float64) -> bool:
        """Whether views of the map found last and of ``slam``'s map bear out ``T_other_present``.

        The views are rendered from past camera poses near ``pose`` (4, 4) in ``slam``'s map.
        """
        own = np.concatenate([slam.keyframe_poses(), pose[None]])
        present = MapViews.of(slam.map, own, pose)
        there = MapViews.of(self.map, self.keyframe_poses(), T_other_present @ pose)
        fit = measure_fit(there, present, T_other_present, _FIT)
        return not why_not_believed(fit)

    def _lookup(self, other: DetachedMap, frames: Images) -> FrameLookup:
        self._slam.reconfigure(self._present.config, self._present.intrinsics)
        if self._loaded is not other:
            self._slam.attach_map(other)
            self._loaded = other
        self._slam.expect_noise(self._present.noise())
        return FrameLookup(self._slam, frames)


class JointSearch(Saved):
    """Search for the pose of the present map relative to one set aside: the agreeing looks."""

    saved = ("_label", "_votes", "_frame", "_pose", "_looks")

    def __init__(self) -> None:
        self._label: int | None = None  # of the map set aside; None: nothing found yet
        self._votes: list[Float64] = []  # (4, 4) T_other_present of each look
        self._frame: int | None = None  # of the last look
        self._pose = np.eye(4)  # (4, 4) in the present map at the last look
        self._looks = 0  # unsuccessful looks since the map was lost

    def state_like(self) -> Any:
        """See ``Stateful``."""
        like = {
            "label": OrNone(WholeNumber(most="submaps")),
            "votes": ListOf(np.eye(4)),
            "frame": OrNone(WholeNumber()),
        }
        return Fields(super().state_like() | like, _why_no_search)

    def is_due(self, frame: int, pose: Float64, rules: SubmapConfig) -> bool:
        """Whether to look now: after an interval, or to confirm a result from another place."""
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
        """Look for the camera at ``pose`` (4, 4) in the maps set aside.

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
    """Error message if the label of a state does not fit its votes."""
    is_known = state["label"] is not None
    return "" if is_known == bool(state["votes"]) else "has votes without a label, or a label alone"


@dataclass(frozen=True)
class MapViews:
    """A map and its views from past camera poses, used in place of recorded frames."""

    backend: SurfelMap
    frames: list[RGBDFrame]  # N
    estimates: Float64  # (N, 4, 4) T_map_camera
    tracked: NDArray[np.bool_]  # (N,) all of them

    @classmethod
    def of(cls, surfel_map: SurfelMap, poses: Float64, here: Float64) -> MapViews:
        """Views from the poses among ``poses`` (K, 4, 4) that are nearest to ``here`` (4, 4)."""
        distance = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1)
        chosen = poses[np.argsort(distance, kind="stable")[: _FIT.queries]]
        frames = _as_frames(surfel_map.predict(chosen))
        return cls(surfel_map, frames, chosen, np.ones(len(chosen), dtype=bool))


def _as_frames(views: Views) -> list[RGBDFrame]:
    grey = np.rint(views.intensity).astype(np.uint8)[..., None].repeat(3, axis=-1)
    return [RGBDFrame(color, depth) for color, depth in zip(grey, views.depth, strict=True)]


CARRIED_ON = 0.95
"""Factor per frame for the last motion, with which a lost camera is extrapolated.

On hand-held paths, lr kt3 and the walk with a HoloLens, extrapolation came 2 to 4 times closer to
the true position after 5 frames than standing still, and 1.7 to 2.6 times closer after 10; 0.8 and
1 did worse on some.
"""
UNFORESEEN = 0.3
"""Standard deviation per extrapolated frame, in units of the last motion."""


class AtlasSubmaps(Saved):
    """The submaps of a SLAM of one camera: a lost camera continues in a new submap.

    With ``SurfelConfig.submaps`` "off" there is one map, and a lost camera waits until it finds it.
    """

    saved = ("_ledger", "_search", "_present", "_unmapped", "_expected", "_motion")

    def __init__(self, slam: BatchedSurfelSlam) -> None:
        self._slam = slam
        self._is_on = slam.config.submaps == "atlas"
        self._finder: MapFinder | None = None  # made when there is something to find
        self.reset()

    def reset(self) -> None:
        """Forget all submaps."""
        self._ledger = SubmapLedger()
        self._detached: list[DetachedMap] = []
        self._search = JointSearch()
        self._present = 0
        self._unmapped = 0  # consecutive frames that showed something and were not mapped
        self._motion = np.eye(4)  # of the last tracked frame
        self._expected = np.eye(4)  # (4, 4) extrapolated pose of a lost camera

    @property
    def _config(self) -> SubmapConfig:
        return self._slam.config.submap_rules

    @property
    def present(self) -> int:
        """Index of the submap in which frames are tracked."""
        return self._present

    @property
    def detached(self) -> Sequence[DetachedMap]:
        """The maps set aside."""
        return self._detached

    def trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Frames (N,) and their poses (N, 4, 4) in the present maps."""
        if not self._ledger.has_several:
            return self._slam.loops.trajectory(0)
        poses: dict[int, Float64] = {}
        for frames, stack in (self._ledger.trajectory(), self._slam.loops.trajectory(0)):
            poses |= dict(zip(frames.tolist(), stack, strict=True))
        order = sorted(poses)
        stack = np.array([poses[frame] for frame in order]).reshape(-1, 4, 4)
        return np.array(order, dtype=np.int32), stack

    def summary(self) -> Submaps:
        """The submaps and the links between them."""
        return self._ledger.summary()

    # -- After every frame ---------------------------------------------------------------------

    def follow(self, frames: Images, guess: ArrayLike | None, result: TrackResult) -> TrackResult:
        """Start a submap after a few refused frames; look for older ones while there are any.

        Returns the result for the frame that was just tracked or refused.
        """
        if not self._is_on:
            return result
        if not result.tracking_ok:
            return self._labelled(self._after_refusal(frames, guess, result))
        self._expected, self._motion = result.T_world_camera, self._slam.motion()
        self._unmapped = self._unmapped + 1 if result.uncertain else 0
        if self._unmapped >= self._config.after and self._slam.shows_something(frames):
            link = self._link(False) if result.covariance is None else result.covariance
            return self._labelled(self._start(frames, link))
        if not self._detached:
            if self._ledger.has_several:
                self._ledger.record(self._slam.last_frame(), self._present, self._expected)
            return self._labelled(result)
        return self._labelled(self._after_tracking(frames, result))

    def _labelled(self, result: TrackResult) -> TrackResult:
        """Add the submap of the frame, and the covariance of that submap's pose."""
        if self._present == 0:
            return result
        pose = result.T_world_camera
        covariance = self._ledger.covariance(self._present, pose)
        if result.covariance is not None:
            covariance = covariance + result.covariance
        if not result.tracking_ok:
            return replace(result, submap=self._present, covariance=None)
        # The first frame of a submap is at a given pose, as far off as the map before it.
        drift = self._slam.drift() if result.drift is None else result.drift
        return replace(result, submap=self._present, covariance=covariance, drift=drift)

    # -- Losing a map --------------------------------------------------------------------------

    def _after_refusal(
        self, frames: Images, guess: ArrayLike | None, result: TrackResult
    ) -> TrackResult:
        share = CARRIED_ON ** self._slam.frames_lost()
        self._expected = self._expected @ se3_exp(share * se3_log(self._motion))
        if guess is not None:
            self._expected = np.array(guess, dtype=np.float64)
        if not self._slam.shows_something(frames):
            return result
        self._unmapped += 1
        if self._unmapped < self._config.after:
            return result
        return self._start(frames, self._link(guess is not None))

    def _link(self, is_guessed: bool) -> Float64:
        """Covariance (6, 6) of the expected camera pose."""
        rules = self._config
        sigmas = np.repeat([rules.guess_sigma_m, np.radians(rules.guess_sigma_deg)], 3)
        if not is_guessed:
            twist = se3_log(self._motion).reshape(2, 3)
            speeds = np.repeat(np.linalg.norm(twist, axis=1), 3)
            sigmas = np.hypot(sigmas, UNFORESEEN * self._slam.frames_lost() * speeds)
        return np.diag(sigmas**2)

    def _start(self, frames: Images, link: Float64) -> TrackResult:
        """Set the map aside and start another with this frame."""
        frame = self._slam.last_frame()
        self._ledger.correct(*self._slam.loops.trajectory(0))
        if len(self._slam.keyframe_poses()) >= self._config.fewest_keyframes:
            self._detached.append(self._slam.detach_map(self._present))
        self._slam.restart(self._expected)
        self._present = self._ledger.start(frame, self._expected, link)
        self._search, self._unmapped = JointSearch(), 0
        result = self._slam.track(frames.color, frames.depth)[0]
        if result.tracking_ok:
            self._ledger.record(frame, self._present, result.T_world_camera)
        return result

    # -- Finding an older one --------------------------------------------------------------------

    def _after_tracking(self, frames: Images, result: TrackResult) -> TrackResult:
        frame, pose = self._slam.last_frame(), result.T_world_camera
        self._ledger.record(frame, self._present, pose)
        if result.uncertain or not self._search.is_due(frame, pose, self._config):
            return result
        if self._finder is None:
            self._finder = MapFinder(self._slam)
        joint = self._search.look(frame, pose, frames, self._detached, self._finder, self._config)
        if joint is None:
            return result
        other, T_other_present = joint
        if not self._finder.bears_out(self._slam, T_other_present, pose):
            return result
        return self._join(other, T_other_present, result)

    def _join(
        self, other: DetachedMap, T_other_present: Float64, result: TrackResult
    ) -> TrackResult:
        """Move the newer map onto the older one, and continue in the merged map."""
        frame, slam, ledger = self._slam.last_frame(), self._slam, self._ledger
        older, newer = sorted((other.label, self._present))
        is_older_present = older == self._present
        correction = invert(T_other_present) if is_older_present else T_other_present
        ledger.correct(*slam.loops.trajectory(0))
        detached = [each for each in self._detached if each is not other]
        for label, part in ledger.between(older, newer, correction).items():
            ledger.move(label, part)
            detached = [each.moved(part) if each.label == label else each for each in detached]
        ledger.join(older, newer, correction, frame)
        here, there = slam.detach_map(older), replace(other.resumed(frame), label=older)
        stable = slam.config.confidence_threshold
        if is_older_present:
            slam.attach_map(here.merged(there.moved(correction), stable))
        else:
            slam.attach_map(there.merged(here.moved(correction), stable))
            slam.move_camera(correction)
        self._detached, self._present, self._search = detached, older, JointSearch()
        self._expected = slam.poses[0].copy()
        return replace(result, T_world_camera=slam.poses[0].copy(), submaps_joined=True)

    def get_state(self) -> dict[str, Any]:
        """The state as NumPy arrays and plain values; empty with submaps "off"."""
        if not self._is_on:
            return {}
        return super().get_state() | {"detached": [each.get_state() for each in self._detached]}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        if not self._is_on:
            return {}
        submap = WholeNumber(most="submaps")
        detached = {
            "surfels": self._slam.map.surfels_like(),
            "keyframes": self._slam.relocalization.keyframes_like(),
            "history": TrajectoryHistory().state_like(),
            "label": submap,
            "since": WholeNumber(),
        }
        like = {"present": submap, "detached": ListOf(detached)}
        return super().state_like() | like

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state of ``get_state``."""
        if not self._is_on:
            return
        super().set_state(state)
        self._detached = [DetachedMap() for _ in state["detached"]]
        for each, values in zip(self._detached, state["detached"], strict=True):
            each.set_state(values)
        if self._finder is not None:
            self._finder.forget()
