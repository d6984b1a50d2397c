"""Loop closure by deformation: the map is bent where its present part meets an older one again.

ElasticFusion (Whelan et al., RSS 2015, sections IV to VI). Surfels not seen for ``window`` frames
are inactive: frames are neither tracked against them nor fused into them. Every few frames

- local: where the inactive part is in view, the live frame is registered with it as it was with
  the active part before; both poses differ by the drift since;
- global: where that gave nothing, keyframes that resemble the frame say where else in the inactive
  part it may be, and it is registered there.

If the registration is good, the deformation graph takes the active part there while it holds the
inactive one, and what is in view becomes one surface, active again. The paper registers the active
part's rendering in place of the live frame; the frame has no holes, and its noise is common to
both poses.

A closed loop makes the estimated pose jump by the drift that it takes back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.loops.base import Bool, Float64, Int32, LoopClosure, SimilarViews
from ms_slam_env.slam.surfel.loops.bending import MapBender
from ms_slam_env.slam.surfel.loops.past import Past, motion_size, past_from_state
from ms_slam_env.slam.surfel.loops.registration import InactiveRegistration, Placement
from ms_slam_env.slam.surfel.surfel_arrays import EARLIEST, any_time
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracking import model_stride
from ms_slam_env.slam.surfel.types import LiveFrame

SIGNIFICANT = 3.0  # drift, in standard deviations of the registration, that is worth bending for
VIEW_APART_M, VIEW_APART_DEG = 1.0, 60.0  # views of one place differ by less


class DeformationLoopClosure(LoopClosure):
    """Closes loops of B envs by embedded deformation."""

    def __init__(self, surfel_map: SurfelMap, config: SurfelConfig, device: str = "cpu") -> None:
        """Close loops of the maps in ``surfel_map`` with ``config.loops``."""
        self.map = surfel_map
        self.config = config.loops
        self.batch = surfel_map.batch
        stride = model_stride(surfel_map.intrinsics, config)
        self._window = any_time(self.batch, device)  # of the inactive surfels
        inactive = surfel_map.model_renderer(stride, self._window)
        active = surfel_map.model_renderer(stride, surfel_map.active)
        self._registration = InactiveRegistration(surfel_map, inactive, config, device)
        self._bender = MapBender(surfel_map, inactive, active, config, device)
        self._seen_from = np.full(self.batch, EARLIEST, dtype=np.int32)
        self._past = [Past() for _ in range(self.batch)]

    def reset(self, env: int) -> None:
        """Forget one env."""
        self._past[env] = Past()

    def select(self, lost: Int32) -> bool:
        """The active surfels, or all while tracking is lost."""
        last = np.array([past.last for past in self._past])
        seen_from = np.where(lost > 0, EARLIEST, last - self.config.window).astype(np.int32)
        changed = not np.array_equal(seen_from, self._seen_from)
        if changed:
            self._seen_from = seen_from
            self.map.active.seen_from.assign(seen_from)
        return changed

    def record(self, poses: Float64, time: Int32, fused: Bool) -> None:
        """Remember the poses of the frames just fused."""
        for env in np.flatnonzero(fused):
            self._past[env].record(self.map, int(env), int(time[env]), poses[env])

    def close(
        self, live: LiveFrame, poses: Float64, time: Int32, tracked: Bool, similar: SimilarViews
    ) -> Bool:
        """Look for loops where it is time to, and close them; see the base class."""
        closed = np.zeros(self.batch, dtype=bool)
        due = tracked & (time > self.config.window) & (time % self.config.interval == 0)
        if not due.any():
            return closed
        self._window.seen_to.assign(time - self.config.window - 1)
        self._registration.set_frame(live)
        near = self._registration.covered(poses, due)
        if near.any():
            there = self._registration.near(poses)
            for env in np.flatnonzero(near & there.found):
                closed[env] = self._close(int(env), poses, there)
                due[env] = False
        due &= time % self.config.global_interval == 0
        for env in np.flatnonzero(due):
            closed[env] = self._close_from_keyframes(int(env), poses, similar)
        return closed

    def _close_from_keyframes(self, env: int, poses: Float64, similar: SimilarViews) -> bool:
        """Look for the frame where similar ones were taken, and close a loop there."""
        past = self._past[env]
        for candidate in similar(env, past.last - self.config.window):
            if candidate.dissimilarity > self.config.dissimilarity:
                break
            allowed_m = self.config.drift_share * past.path_m(candidate.time)
            if not _may_be_the_same(poses[env], candidate.T_world_camera, allowed_m):
                continue
            starts = np.full((self.batch, 4, 4), np.nan)
            starts[env] = candidate.T_world_camera
            there = self._registration.from_keyframes(starts)
            drift = np.linalg.norm(there.T_world_live[env, :3, 3] - poses[env, :3, 3])
            if there.found[env] and drift <= allowed_m:
                return self._close(env, poses, there)
        return False

    def _close(self, env: int, poses: Float64, there: Placement) -> bool:
        """Bend map, pose and past of one env; returns whether that was believed and done."""
        past, corrected = self._past[env], there.T_world_live[env]
        drift = motion_size(invert(poses[env]) @ corrected)
        if drift < self.config.smallest_m:
            self._bender.join_parts(env, poses[env], past.last)
            return False
        if drift < SIGNIFICANT * there.sigma[env] or not past.confirms(
            poses[env], corrected, self.config.agreement_m, 2 * self.config.global_interval
        ):
            return False
        bent = self._bender.bend(env, poses[env], corrected, past.joined)
        if bent is None:
            return False
        deformation, joined = bent
        past.move(deformation, joined, corrected)
        poses[env] = corrected
        self._bender.join_parts(env, corrected, past.last)
        return True

    def trajectory(self, env: int) -> tuple[Int32, Float64]:
        """Tracked frames (N,) and their poses (N, 4, 4), bent by the closures since."""
        return self._past[env].trajectory()

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return {"past": [past.get_state() for past in self._past]}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self._past = [past_from_state(past) for past in state["past"]]


def _may_be_the_same(pose: Float64, keyframe: Float64, drift_m: float) -> bool:
    """Whether a keyframe may show what is in view from ``pose``, which has drifted."""
    apart = np.linalg.norm(pose[:3, 3] - keyframe[:3, 3])
    angle = relative_angle(pose[:3, :3], keyframe[:3, :3])
    return bool(apart <= VIEW_APART_M + drift_m and angle <= np.radians(VIEW_APART_DEG))
