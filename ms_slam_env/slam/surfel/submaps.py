"""Submaps of the surfel SLAM of one camera: begin one when lost, find older ones, join them.

The idea of ORB-SLAM's Atlas (Elvira, Tardós and Montiel, IROS 2019). A frame that is refused is not
the end: after a few of them the map is put aside, and a new one starts where the camera is best
guessed to be. While it grows, every few frames the camera is looked for in the maps put aside: near
where it should be and at keyframes that resemble the frame. Several such looks from different
places must agree on how the maps lie, and the views of both maps must agree there; then the newer
map is moved onto the older, and both are one again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.geometry import invert, se3_exp, se3_log
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ListOf, WholeNumber
from ms_slam_env.slam.shared.submap_frames import SubmapLedger, Submaps, one_submap
from ms_slam_env.slam.slam_backend import Float64, TrackResult
from ms_slam_env.slam.surfel.detached_map import DetachedMap
from ms_slam_env.slam.surfel.map_search import JointSearch, MapFinder
from ms_slam_env.slam.surfel.relocalization import Images
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_config import SubmapConfig
from ms_slam_env.slam.surfel.trajectory_history import TrajectoryHistory

CARRIED_ON = 0.95
"""From frame to frame, of the last motion, which is all that is known of a lost camera.

On hand-held paths, lr kt3 and the walk with a HoloLens it put the camera after 5 frames 2 to 4
times, after 10 frames 1.7 to 2.6 times closer to where it was than standing still; 0.8 and 1 did
worse on some.
"""
UNFORESEEN = 0.3
"""Standard deviation of a coordinate of that pose, in last motions, by every frame carried on."""


class NoSubmaps(Saved):
    """The variant "off": a lost camera stands still until it finds its map again."""

    def __init__(self, slam: BatchedSurfelSlam) -> None:
        self._slam = slam

    def reset(self) -> None:
        """Forget all submaps."""

    def follow(self, frames: Images, guess: ArrayLike | None, result: TrackResult) -> TrackResult:
        """Do what is to be done after a frame was tracked or not; the result to return for it."""
        return result

    def detached(self) -> Sequence[DetachedMap]:
        """The maps put aside."""
        return ()

    @property
    def present(self) -> int:
        """Number of the submap that frames are tracked in."""
        return 0

    def trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Frames (N,) and their poses (N, 4, 4) as the maps have them now."""
        return self._slam.loops.trajectory(0)

    def summary(self) -> Submaps:
        """The submaps as they hang together."""
        return one_submap()


class AtlasSubmaps(NoSubmaps):
    """The variant "atlas": a lost camera goes on in a new submap."""

    saved = ("_ledger", "_search", "_present", "_refused", "_expected", "_motion")

    def __init__(self, slam: BatchedSurfelSlam) -> None:
        super().__init__(slam)
        self._finder: MapFinder | None = None  # made when there is something to find
        self.reset()

    def reset(self) -> None:
        """Forget all submaps."""
        self._ledger = SubmapLedger()
        self._detached: list[DetachedMap] = []
        self._search = JointSearch()
        self._present = 0
        self._refused = 0  # frames in a row that showed something and were not tracked
        self._motion = np.eye(4)  # of the last tracked frame
        self._expected = np.eye(4)  # (4, 4) where that takes a camera that is lost

    @property
    def _config(self) -> SubmapConfig:
        return self._slam.config.submap_rules

    @property
    def present(self) -> int:
        """Number of the submap that frames are tracked in."""
        return self._present

    def detached(self) -> Sequence[DetachedMap]:
        """The maps put aside."""
        return self._detached

    def trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Frames (N,) and their poses (N, 4, 4) as the maps have them now."""
        poses: dict[int, Float64] = {}
        for frames, stack in (self._ledger.trajectory(), self._slam.loops.trajectory(0)):
            poses |= dict(zip(frames.tolist(), stack, strict=True))
        order = sorted(poses)
        stack = np.array([poses[frame] for frame in order]).reshape(-1, 4, 4)
        return np.array(order, dtype=np.int32), stack

    def summary(self) -> Submaps:
        """The submaps as they hang together."""
        return self._ledger.summary()

    # -- After every frame ---------------------------------------------------------------------

    def follow(self, frames: Images, guess: ArrayLike | None, result: TrackResult) -> TrackResult:
        """Start a submap after a few refused frames, look for older ones while there are any."""
        if not result.tracking_ok:
            return self._labelled(self._after_refusal(frames, guess, result))
        self._refused = 0
        self._expected, self._motion = result.T_world_camera, self._slam.motion()
        if not self._detached:
            if self._ledger.has_several:
                self._ledger.record(self._slam.last_frame(), self._present, self._expected)
            return self._labelled(result)
        return self._labelled(self._after_tracking(frames, result))

    def _labelled(self, result: TrackResult) -> TrackResult:
        """Say which submap the frame is in, and how sure it is where that lies."""
        if self._present == 0:
            return result
        pose = result.T_world_camera
        covariance = self._ledger.covariance(self._present, pose)
        if result.covariance is not None:
            covariance = covariance + result.covariance
        return replace(
            result, submap=self._present, covariance=covariance if result.tracking_ok else None
        )

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
        self._refused += 1
        if self._refused < self._config.after:
            return result
        return self._start(frames, self._link(guess is not None))

    def _link(self, is_guessed: bool) -> Float64:
        """Covariance (6, 6) of where the camera is expected."""
        rules = self._config
        sigmas = np.repeat([rules.guess_sigma_m, np.radians(rules.guess_sigma_deg)], 3)
        if not is_guessed:
            twist = se3_log(self._motion).reshape(2, 3)
            speeds = np.repeat(np.linalg.norm(twist, axis=1), 3)
            sigmas = np.hypot(sigmas, UNFORESEEN * self._slam.frames_lost() * speeds)
        return np.diag(sigmas**2)

    def _start(self, frames: Images, link: Float64) -> TrackResult:
        """Put the map aside and start another with this frame."""
        frame = self._slam.last_frame()
        self._ledger.correct(*self._slam.loops.trajectory(0))
        if len(self._slam.keyframe_poses()) >= self._config.fewest_keyframes:
            self._detached.append(self._slam.detach_map(self._present))
        self._slam.restart(self._expected)
        self._present = self._ledger.start(frame, self._expected, link)
        self._search, self._refused = JointSearch(), 0
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
        """Move the newer map onto the older one, and go on in both as one."""
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
        """Everything, as NumPy arrays and plain values."""
        return super().get_state() | {"detached": [each.get_state() for each in self._detached]}

    def state_like(self) -> Any:
        """See ``Stateful``."""
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
        """Go on from a state."""
        super().set_state(state)
        self._detached = [DetachedMap() for _ in state["detached"]]
        for each, values in zip(self._detached, state["detached"], strict=True):
            each.set_state(values)
        if self._finder is not None:
            self._finder.forget()


def make_submaps(slam: BatchedSurfelSlam) -> NoSubmaps:
    """The variant ``config.submaps`` for a SLAM of one camera."""
    return AtlasSubmaps(slam) if slam.config.submaps == "atlas" else NoSubmaps(slam)
