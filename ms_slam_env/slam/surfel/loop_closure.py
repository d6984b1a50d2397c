"""Loop closure by deformation, where the present part of the map meets an older part again.

ElasticFusion (Whelan et al., RSS 2015, sections IV to VI). Surfels not seen for ``window`` frames
are inactive: frames are neither tracked against them nor fused into them. Every few frames:

- local: if the inactive part is in view, the live frame is aligned with it, as it was with the
  active part before; the two poses differ by the drift since;
- global: if that finds nothing, similar keyframes propose other places in the inactive part, and
  the frame is aligned there.

If the alignment is good, the deformation graph moves the active part there and holds the inactive
one; the surfels in view become one active surface. The paper aligns the rendering of the active
part instead of the live frame; the live frame has no holes, and its noise is common to both poses.

Closing a loop makes the estimated pose jump by the drift that it corrects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ms_slam_env._runtime.arrays import Bool, Float64, Int32
from ms_slam_env._runtime.warp import wp
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.alignment_check import TrackingStatus
from ms_slam_env.slam.shared.ferns import Candidate
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.slam_backend import Loop
from ms_slam_env.slam.surfel.acceptance import Alignment, acceptance_thresholds
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.map_deformation import MapDeformer
from ms_slam_env.slam.surfel.pose_hypotheses import (
    NUM_HYPOTHESES,
    is_within,
    relocalization_hypotheses,
    tracking_hypotheses,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import SplatRenderer
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.surfels import EARLIEST, any_time
from ms_slam_env.slam.surfel.tracker import Tracker, model_stride
from ms_slam_env.slam.surfel.trajectory_history import TrajectoryHistory, motion_size

SimilarViews = Callable[[int, int], list[Candidate]]
"""Keyframes of an env, taken before a frame, that resemble the one just tracked, best first."""
ClosedLoop = tuple[Loop, Float64]
"""A loop, and the camera's pose (4, 4) after it was closed."""


class LoopClosure(Saved):
    """Recognises places seen before and deforms the maps of B envs so that both passes coincide.

    This base class is the variant "none": frames are tracked against the whole map, old and new;
    nothing is deformed, and returned poses are final.
    """

    def __init__(self, batch: int) -> None:
        self.batch = batch

    def reset(self, env: int) -> None:
        """Forget one env."""

    def select(self, lost: Int32) -> bool:
        """Choose the surfels that the next frames use; return whether the choice has changed.

        ``lost`` (B,) counts the frames since tracking was lost; 0 = tracked.
        """
        return False

    def record(self, poses: Float64, time: Int32, fused: Bool) -> None:
        """Record the frames ``time`` (B,) at ``poses`` (B, 4, 4), of the envs ``fused`` (B,)."""

    def close(
        self, live: LiveFrame, poses: Float64, time: Int32, tracked: Bool, similar: SimilarViews
    ) -> Mapping[int, ClosedLoop]:
        """Look for loops at the recorded frames ``time`` (B,); return the closed ones by env.

        Maps are corrected in place; ``poses`` (B, 4, 4) are not changed.
        """
        return {}

    def trajectory(self, env: int) -> tuple[Int32, Float64]:
        """Fused frames (N,) and their poses (N, 4, 4), moved by later loop closures.

        Empty if no trajectory is kept.
        """
        return np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4))

    def get_history(self, env: int) -> TrajectoryHistory:
        """A copy of the history of one env; empty if none is kept."""
        return TrajectoryHistory()

    def set_history(self, env: int, history: TrajectoryHistory) -> None:
        """Set the history of one env."""


LARGEST_SIGMA = 0.01  # standard deviation (metres, radians) of an alignment's worst direction
LEAST_INLIERS = 0.7  # share of matched points that an alignment explains
LARGEST_DEG = 20.0  # largest accepted correction of the camera's rotation
LARGEST_DISSIMILARITY = 0.3  # of a frame and a keyframe of the same place, share of the ferns
AGREEMENT_M = 0.01  # two looks must agree on the correction to within this, at 1 m
SETTLED = 0.02, np.radians(2.0)  # largest motion of a repeated alignment


class InactiveAligner:
    """Aligns the frames of B envs with the inactive part of their maps."""

    def __init__(
        self, surfel_map: SurfelMap, inactive: SplatRenderer, config: SurfelConfig, device: str
    ) -> None:
        self.config = config.loops
        self._acceptance = config.acceptance
        self.batch = surfel_map.batch
        self._inactive = inactive
        intrinsics = surfel_map.intrinsics
        stride = model_stride(intrinsics, config)
        self._tracker = Tracker(self.batch, NUM_HYPOTHESES, intrinsics, config, device, stride)
        self._poses = SavedBuffer(self.batch, wp.mat44, device)

    def set_frame(self, live: LiveFrame) -> None:
        """Set the frames to align next."""
        self._tracker.set_frame(live)

    def covered(self, poses: Float64, due: Bool) -> Bool:
        """Which envs (B,) among ``due`` (B,) see enough of the inactive part from ``poses``.

        Renders the view of it for these envs.
        """
        self._poses.write(poses)
        self._inactive.cull(self._poses.array)
        pixels = self._inactive.intrinsics.width * self._inactive.intrinsics.height
        counts = self._inactive.visible.count.numpy()
        due = due & (counts > 0.1 * self.config.coverage * pixels)
        if not due.any():
            return due
        view = self._inactive.splat()
        shares = (view.vertices.numpy()[..., 2] > 0).mean(axis=(1, 2))
        return due & (shares >= self.config.coverage)

    def near(self, poses: Float64) -> Alignment:
        """Align with the view that ``covered`` rendered from ``poses``."""
        return self._align(poses, tracking_hypotheses(np.eye(4)), self.config.largest_m)

    def from_keyframes(self, starts: Float64) -> Alignment | None:
        """Align from rough and possibly wrong poses (B, 4, 4), NaN for an env without one.

        A result counts only if a second alignment from there confirms it; None if there is none.
        """
        given = np.isfinite(starts[:, 0, 0])
        origins = np.where(given[:, None, None], starts, np.eye(4))
        given &= self.covered(origins, given)
        if not given.any():
            return None
        first = self._align(origins, relocalization_hypotheses(0), 0.6)
        good = given & first.tracked
        origins = np.where(good[:, None, None], first.T_world_live, np.eye(4))
        good &= self.covered(origins, good)
        if not good.any():
            return None
        again = self._align(origins, tracking_hypotheses(np.eye(4)), 0.1)
        settled = [
            is_within(*pair, *SETTLED) for pair in zip(origins, again.T_world_live, strict=True)
        ]
        return again.with_status(~good | ~np.array(settled), TrackingStatus.IMPLAUSIBLE_MOTION)

    def _align(self, origins: Float64, hypotheses: Float64, largest_m: float) -> Alignment:
        stack = np.tile(hypotheses, (self.batch, 1, 1, 1))
        strict, lost = np.ones(self.batch, dtype=bool), np.zeros(self.batch, dtype=np.int32)
        thresholds = acceptance_thresholds(self._acceptance, strict, lost)
        thresholds["sigma_m"] = LARGEST_SIGMA
        thresholds["inlier_ratio"] = LEAST_INLIERS
        thresholds["motion_m"] = largest_m
        thresholds["rotation_cos"] = np.cos(np.radians(LARGEST_DEG))
        return self._tracker.align(self._inactive.view, origins, stack, thresholds)


SIGNIFICANT = 3.0  # least drift to deform for, in standard deviations of the alignment
VIEW_APART_M, VIEW_APART_RAD = 1.0, np.radians(60.0)  # views of one place differ by less


class DeformationLoopClosure(LoopClosure):
    """Closes loops of B envs by embedded deformation."""

    saved = ("_histories",)

    def __init__(self, surfel_map: SurfelMap, config: SurfelConfig, device: str = "cpu") -> None:
        self.map = surfel_map
        self.config = config.loops
        self.batch = surfel_map.batch
        stride = model_stride(surfel_map.intrinsics, config)
        self._window = any_time(self.batch, device)  # of the inactive surfels
        inactive = surfel_map.model_renderer(stride, self._window)
        active = surfel_map.model_renderer(stride, surfel_map.active)
        self._aligner = InactiveAligner(surfel_map, inactive, config, device)
        self._deformer = MapDeformer(surfel_map, inactive, active, config, device)
        self._seen_from = np.full(self.batch, EARLIEST, dtype=np.int32)
        self._histories = [TrajectoryHistory() for _ in range(self.batch)]

    def reset(self, env: int) -> None:
        """Forget one env."""
        self._histories[env] = TrajectoryHistory()

    def select(self, lost: Int32) -> bool:
        """Use the active surfels, or all of them while tracking is lost; see the base class."""
        last = np.array([history.last for history in self._histories])
        seen_from = np.where(lost > 0, EARLIEST, last - self.config.window).astype(np.int32)
        changed = not np.array_equal(seen_from, self._seen_from)
        if changed:
            self._seen_from = seen_from
            self.map.active.seen_from.assign(seen_from)
        return changed

    def record(self, poses: Float64, time: Int32, fused: Bool) -> None:
        """Remember the poses of the frames just fused."""
        for env in np.flatnonzero(fused):
            self._histories[env].record(self.map, int(env), int(time[env]), poses[env])

    def close(
        self, live: LiveFrame, poses: Float64, time: Int32, tracked: Bool, similar: SimilarViews
    ) -> Mapping[int, ClosedLoop]:
        """Look for loops in the envs that are due, and close them; see the base class."""
        found: dict[int, ClosedLoop | None] = {}
        due = tracked & (time > self.config.window) & (time % self.config.interval == 0)
        if not due.any():
            return {}
        self._window.seen_to.assign(time - self.config.window - 1)
        self._aligner.set_frame(live)
        near = self._aligner.covered(poses, due)
        if near.any():
            there = self._aligner.near(poses)
            for env in np.flatnonzero(near & there.tracked):
                found[int(env)] = self._close(int(env), poses, there)
                due[env] = False
        due &= time % self.config.global_interval == 0
        for env in np.flatnonzero(due):
            found[int(env)] = self._close_from_keyframes(int(env), poses, similar)
        return {env: loop for env, loop in found.items() if loop is not None}

    def _close_from_keyframes(
        self, env: int, poses: Float64, similar: SimilarViews
    ) -> ClosedLoop | None:
        """Look for the frame at similar keyframes, and close a loop there."""
        history = self._histories[env]
        for candidate in similar(env, history.last - self.config.window):
            if candidate.dissimilarity > LARGEST_DISSIMILARITY:
                break
            allowed_m = self.config.drift_share * history.path_m(candidate.time)
            apart = VIEW_APART_M + allowed_m, VIEW_APART_RAD
            if not is_within(poses[env], candidate.T_world_camera, *apart):
                continue
            starts = np.full((self.batch, 4, 4), np.nan)
            starts[env] = candidate.T_world_camera
            there = self._aligner.from_keyframes(starts)
            if there is None:
                continue
            drift = np.linalg.norm(there.T_world_live[env, :3, 3] - poses[env, :3, 3])
            if there.tracked[env] and drift <= allowed_m:
                return self._close(env, poses, there)
        return None

    def _close(self, env: int, poses: Float64, there: Alignment) -> ClosedLoop | None:
        """Deform map and history of one env; return loop and camera pose, or None if refused."""
        history, corrected = self._histories[env], there.T_world_live[env]
        loop = history.loop_at(corrected, history.last - self.config.window)
        drift = motion_size(invert(poses[env]) @ corrected)
        if drift < self.config.smallest_m:
            self._deformer.join_parts(env, poses[env], history.last)
            return replace(loop, bent=False), poses[env]
        if drift < SIGNIFICANT * there.statistics["sigma_m"][env] or not history.confirms(
            poses[env], corrected, AGREEMENT_M, 2 * self.config.global_interval
        ):
            return None
        deformed = self._deformer.deform(env, poses[env], corrected, history.joined)
        if deformed is None:
            return None
        deformation, joined = deformed
        history.move(deformation, joined, corrected)
        self._deformer.join_parts(env, corrected, history.last)
        return loop, corrected

    def trajectory(self, env: int) -> tuple[Int32, Float64]:
        """Tracked frames (N,) and their poses (N, 4, 4), moved by the closures since."""
        return self._histories[env].trajectory()

    def get_history(self, env: int) -> TrajectoryHistory:
        """A copy of the history of one env."""
        copied = TrajectoryHistory()
        copied.set_state(self._histories[env].get_state())
        return copied

    def set_history(self, env: int, history: TrajectoryHistory) -> None:
        """Set the history of one env."""
        self._histories[env] = history


def make_loop_closure(surfel_map: SurfelMap, config: SurfelConfig, device: str) -> LoopClosure:
    """The loop closure ``config.loop_closure`` for the maps in ``surfel_map``."""
    if config.loop_closure == "none":
        return LoopClosure(surfel_map.batch)
    return DeformationLoopClosure(surfel_map, config, device)
