"""The surfel SLAM: preprocess, render the map, track the frame against that view, fuse.

ElasticFusion (Whelan et al., RSS 2015, figure 2). While tracking is lost the
pose is held, nothing is fused, and every frame is tried against the map around the last good pose
and around keyframes that resemble it (``relocalization``).
The view that frames are tracked against shows living surfels of every age: with steps of
centimetres a view seldom lasts until its surfels are stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import check_pose, invert
from ms_slam_env.slam.base import Float64, TrackResult
from ms_slam_env.slam.ferns import Candidate
from ms_slam_env.slam.surfel.acceptance import (
    APPEARANCE,
    OK,
    REASONS,
    STAT_CONFLICT,
    STAT_DEGENERATE,
    STAT_INLIER_FRACTION,
    STAT_RESIDUAL_M,
    Alignment,
    accept_any_fit,
    geometric_limits,
    make_limits,
)
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.device import Mirror
from ms_slam_env.slam.surfel.loop_closure import make_loop_closure
from ms_slam_env.slam.surfel.photometry import (
    BLANK,
    REASON,
    BlankFrames,
    follow,
    geometry_only,
    same_exposure,
)
from ms_slam_env.slam.surfel.pipeline import FrontEnd, FrontEnds, check_change
from ms_slam_env.slam.surfel.pose_hypotheses import (
    NUM_SEEDS,
    check_guesses,
    check_poses,
    damped,
    motion_weight,
    relocalisation_seeds,
    tracking_seeds,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame, check_images
from ms_slam_env.slam.surfel.relocalization import Images, make_relocalisation
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracker import NUM_FIRST, model_stride

RETRIES = 2  # further searches within a frame whose tracking failed
FEWEST_READINGS = 0.05  # share of the first frame's pixels that must have depth


class BatchedSurfelSlam:
    """The SLAM of B envs in lockstep; each env's results are those it would have alone."""

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str = "cpu"
    ) -> None:
        """Allocate maps and buffers for ``batch`` envs with one camera model."""
        self.batch = batch
        self.map = SurfelMap(batch, intrinsics, config, device, model_stride(intrinsics, config))
        self._front_ends = FrontEnds(self.map)
        self.loops = make_loop_closure(self.map, config, device)
        self.relocalisation = make_relocalisation(batch, intrinsics, config)
        self._blank_frames = BlankFrames(batch)
        self._device_poses = Mirror(batch, wp.mat44, device)
        self._device_time = Mirror(batch, wp.int32, device)
        self._device_weight = Mirror(batch, wp.float32, device)
        self._device_mask = Mirror(batch, wp.int32, device)
        self.poses: Float64 = np.tile(np.eye(4), (batch, 1, 1))
        self._motions: Float64 = np.tile(np.eye(4), (batch, 1, 1))
        self._photometry = same_exposure(batch)
        self._started = np.zeros(batch, dtype=bool)
        self._lost = np.zeros(batch, dtype=np.int32)  # frames since tracking was lost
        self._time = np.zeros(batch, dtype=np.int32)
        self._view: ModelView
        self._view_poses: Float64 | None = None  # of ``_view``; None: the maps have changed since
        self._use(self._front_ends.get(intrinsics, config))

    def reconfigure(self, config: SurfelConfig, intrinsics: Intrinsics) -> None:
        """Go on with other parameters and frame size; see ``SurfelSlam.reconfigure``."""
        if (config, intrinsics) == (self.config, self.intrinsics):
            return
        check_change(self.config, config, intrinsics != self.intrinsics)
        self.relocalisation.adapt(intrinsics, config.depth_cutoff_m)
        self._use(self._front_ends.get(intrinsics, config))

    def _use(self, front_end: FrontEnd) -> None:
        """Look at frames, and at the maps, in this way from now on."""
        self.intrinsics, self.config = front_end.intrinsics, front_end.config
        self.preprocess, self.tracker = front_end.preprocess, front_end.tracker
        self._correct_exposure = front_end.correct_exposure
        self.map.use(front_end.passes)
        self._view_poses = None

    def reset(self, T_world_camera: ArrayLike | None = None, env: int = 0) -> None:
        """Forget one env; its next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self.poses[env] = check_pose(pose, "T_world_camera")
        self._motions[env] = np.eye(4)
        self._photometry[env] = same_exposure(1)[0]
        self._started[env] = False
        self._lost[env] = 0
        self._time[env] = 0
        self.map.clear(env)
        self.relocalisation.clear(env)
        self.loops.reset(env)
        self._view_poses = None

    def track(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        T_world_camera_guess: Sequence[ArrayLike | None] | None = None,
    ) -> list[TrackResult]:
        """Track and fuse one frame per env: colour (B, H, W, 3) uint8, depth (B, H, W) metres.

        ``T_world_camera_guess`` holds for every env a pose (4, 4) to start from too, or None.

        Raises:
            InputError: another batch or image size; NaN, infinite or negative depth; a guess
                that is no pose.
        """
        check_images(color, depth, self.batch, self.intrinsics)
        guesses = check_guesses(T_world_camera_guess, self.batch)
        live = self.preprocess(color, depth)
        self._select_surfels(self._lost)
        frames = Images(color, depth)
        results = self._locate(live, guesses, frames)
        good = np.array([result.tracking_ok for result in results])
        self._correct_exposure(live, self._photometry)
        self.relocalisation.remember(frames, self.poses, self._time, good)
        self._fuse(live, good)
        return self._close_loops(live, results, frames)

    def fuse(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32], T_world_camera: Float64
    ) -> list[TrackResult]:
        """Fuse one frame per env at known poses (B, 4, 4), without tracking.

        Raises:
            InputError: another batch or image size; NaN, infinite or negative depth; no poses.
        """
        check_images(color, depth, self.batch, self.intrinsics)
        poses = check_poses(T_world_camera, self.batch)
        live = self.preprocess(color, depth)
        self._select_surfels(np.ones(self.batch, dtype=np.int32))  # known poses: old and new fit
        self._blank_frames.find(color, self._started)
        for env in range(self.batch):
            moves_on = self._started[env] and not self._lost[env]
            motion = invert(self.poses[env]) @ poses[env]
            self._motions[env] = motion if moves_on else np.eye(4)
            # With too little to see, the first frame that is tracked starts the map.
            self._started[env] = self._started[env] or self._readings(env, live) >= FEWEST_READINGS
        self.poses = poses
        self._lost[:] = 0
        good = np.ones(self.batch, dtype=bool)
        self.relocalisation.remember(Images(color, depth), poses, self._time, good)
        self._fuse(live, good)
        return [TrackResult(pose.copy(), True) for pose in poses]

    def _locate(
        self, live: LiveFrame, guesses: Float64 | None, frames: Images
    ) -> list[TrackResult]:
        """Poses of the live frames: given for the first, tracked or searched for the others."""
        self.tracker.set_frame(live)
        lost = self._lost > 0
        seeds = np.stack(
            [
                relocalisation_seeds(int(self._lost[env]) - 1)
                if lost[env]
                else tracking_seeds(self._motions[env])
                for env in range(self.batch)
            ]
        )
        limits = make_limits(lost, self._lost)
        view = self.render(self.poses)
        alignment = self.tracker.align(view, self.poses, seeds, limits, guesses, self._photometry)
        blank = self._blank_frames.find(frames.color, self._started)
        alignment = replace(alignment, verdict=np.where(blank, BLANK, alignment.verdict))
        alignment = self._without_color(view, seeds, alignment)
        if not self.config.refuse_bad_fits:
            alignment = accept_any_fit(alignment)
        if guesses is not None:
            alignment = self._search_at_guess(alignment, guesses)
        alignment = self._search_again(alignment)
        if self.config.refuse_bad_fits:
            alignment = self._search_elsewhere(alignment, frames)
        return [
            self._accept(env, alignment) if self._started[env] else self._start(env, live)
            for env in range(self.batch)
        ]

    def _without_color(self, view: ModelView, seeds: Float64, alignment: Alignment) -> Alignment:
        """Align the envs whose grey values do not fit by geometry alone, from the nearest seeds.

        Lights are switched, cameras glare, and a recording's colour may not be registered with its
        depth. Geometry must then constrain the pose without help, near to where it is expected.
        """
        failed = self._failed(alignment) & (alignment.verdict == APPEARANCE)
        if not failed.any():
            return alignment
        near = np.repeat(seeds[:, :1], NUM_SEEDS, axis=1)
        near[:, :NUM_FIRST] = seeds[:, :NUM_FIRST]
        again = self.tracker.align(
            view,
            self.poses,
            near,
            geometric_limits(self._lost),
            photometry=geometry_only(self._photometry),
        )
        return alignment.replace(failed & (again.verdict == OK), again)

    def _search_at_guess(self, alignment: Alignment, guesses: Float64) -> Alignment:
        """Align the envs that failed with the view from their guess, under stricter limits.

        A large motion leaves little of the last pose's view in sight.
        """
        failed = self._failed(alignment) & np.isfinite(guesses[:, 0, 0])
        if not failed.any():
            return alignment
        origins = np.where(failed[:, None, None], guesses, self.poses)
        seeds = np.tile(tracking_seeds(np.eye(4)), (self.batch, 1, 1, 1))
        limits = make_limits(np.ones(self.batch, dtype=bool), self._lost)
        view, lights = self.render(origins), self._photometry
        again = self.tracker.align(view, origins, seeds, limits, photometry=lights)
        again = replace(again, T_model_live=invert(self.poses) @ again.T_world_live)
        return alignment.replace(failed & (again.verdict == 0), again)

    def _search_again(self, alignment: Alignment) -> Alignment:
        """Give the envs that failed more starting poses, under stricter limits."""
        strict = np.ones(self.batch, dtype=bool)
        for attempt in range(1, 1 + RETRIES):
            failed = self._failed(alignment)
            if not failed.any():
                break
            seeds = np.stack(
                [relocalisation_seeds(attempt + RETRIES * int(lost)) for lost in self._lost]
            )
            again = self.tracker.align(
                self.render(self.poses),
                self.poses,
                seeds,
                make_limits(strict, self._lost),
                photometry=self._photometry,
            )
            alignment = alignment.replace(failed & (again.verdict == 0), again)
        return alignment

    def _search_elsewhere(self, alignment: Alignment, frames: Images) -> Alignment:
        """Let the relocalisation judge and find the envs that were lost before."""
        lost = self._lost > 0
        again = lost & (alignment.verdict == OK)
        believed = self.relocalisation.believes(frames, alignment.T_world_live, again, self)
        wrong = again & ~believed
        alignment = replace(alignment, verdict=np.where(wrong, APPEARANCE, alignment.verdict))
        found = self.relocalisation.search(frames, lost & self._failed(alignment), self)
        if found is None:
            return alignment
        where, elsewhere = found
        motions = invert(self.poses) @ elsewhere.T_world_live
        return alignment.replace(where, replace(elsewhere, T_model_live=motions))

    def align_from(self, origins: Float64, seeds: Float64, limits: NDArray[np.void]) -> Alignment:
        """Align the current frames with the maps as seen from ``origins`` (B, 4, 4)."""
        view, lights = self.render(origins), self._photometry
        return self.tracker.align(view, origins, seeds, limits, photometry=lights)

    def _failed(self, alignment: Alignment) -> NDArray[np.bool_]:
        return self._started & (alignment.verdict != OK) & (alignment.verdict != BLANK)

    def _readings(self, env: int, live: LiveFrame) -> float:
        """Share of a frame's pixels that have depth."""
        return float((live.depth[env].numpy() > 0).mean())

    def _start(self, env: int, live: LiveFrame) -> TrackResult:
        """Take the first frame at the given pose, if there is something in it to map."""
        if self._readings(env, live) < FEWEST_READINGS:
            reason = "the first frame has too few depth readings"
            return TrackResult(self.poses[env].copy(), False, inlier_fraction=0.0, reason=reason)
        self._started[env] = True
        return TrackResult(self.poses[env].copy(), True)

    def _accept(self, env: int, alignment: Alignment) -> TrackResult:
        """Move on if the verdict is good, else hold the pose."""
        code = int(alignment.verdict[env])
        relocalised = code == 0 and bool(self._lost[env])
        if code == 0:
            self.poses[env] = alignment.T_world_live[env]
            # Across a gap the motion is not one frame's.
            motion = np.eye(4) if relocalised else alignment.T_model_live[env]
            # What a degenerate view leaves open was predicted itself: let it die away.
            is_degenerate = alignment.stats[env, STAT_DEGENERATE] > 0
            self._motions[env] = damped(motion) if is_degenerate else motion
            self._lost[env] = 0
            self._photometry[env] = follow(
                self._photometry[env],
                alignment.photometry[env],
                float(alignment.stats[env, STAT_CONFLICT]),
                self.config.cauchy_rgb,
            )
        else:
            self._motions[env] = np.eye(4)
            self._lost[env] += 1
        return TrackResult(
            T_world_camera=self.poses[env].copy(),
            tracking_ok=code == 0,
            relocalised=relocalised,
            inlier_fraction=float(alignment.stats[env, STAT_INLIER_FRACTION]),
            residual_m=float(alignment.stats[env, STAT_RESIDUAL_M]),
            reason=REASON if code == BLANK else REASONS[code],
            degenerate_directions=int(alignment.stats[env, STAT_DEGENERATE]),
            covariance=alignment.covariance[env] if code == 0 else None,
        )

    def _fuse(self, live: LiveFrame, good: NDArray[np.bool_]) -> None:
        """Fuse the frames with a good pose; a fast camera's readings weigh less."""
        if not good.any():
            self._time += 1
            return
        self._device_poses.write(self.poses)
        self._device_time.write(self._time)
        self._device_weight.write(motion_weight(self._motions))
        self._device_mask.write(good)
        self.map.fuse(
            live,
            self._device_poses.array,
            self._device_time.array,
            self._device_weight.array,
            self._device_mask.array,
        )
        self.loops.record(self.poses, self._time, good)
        self._time += 1
        self._view_poses = None

    def _select_surfels(self, lost: NDArray[np.int32]) -> None:
        """Let loop closure choose what frames are aligned with and fused into."""
        if self.loops.select(lost):
            self._view_poses = None

    def _close_loops(
        self, live: LiveFrame, results: list[TrackResult], frames: Images
    ) -> list[TrackResult]:
        """Close loops after fusion; a closed one corrects the map and the pose."""

        def similar(env: int, before: int) -> list[Candidate]:
            return self.relocalisation.similar(env, frames, before)

        tracked = np.array([result.tracking_ok for result in results])
        closed = self.loops.close(live, self.poses, self._time - 1, tracked, similar)
        for env in np.flatnonzero(closed):
            self.relocalisation.move(int(env), *self.loops.trajectory(int(env)))
            results[env] = replace(
                results[env], T_world_camera=self.poses[env].copy(), loop_closed=True
            )
        return results

    def render(self, poses: Float64) -> ModelView:
        """Render the maps from ``poses`` (B, 4, 4), unless that view is at hand."""
        if self._view_poses is None or not np.array_equal(self._view_poses, poses):
            self._device_poses.write(poses)
            self._view = self.map.render_model(self._device_poses.array)
            self._view_poses = poses.copy()
        return self._view

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return {
            "poses": self.poses.copy(),
            "motions": self._motions.copy(),
            "photometry": self._photometry.copy(),
            "started": self._started.copy(),
            "colorless": self._blank_frames.colorless.copy(),
            "lost": self._lost.copy(),
            "time": self._time.copy(),
            "map": self.map.get_state(),
            "relocalisation": self.relocalisation.get_state(),
            "loops": self.loops.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of a SLAM of the same batch, intrinsics and configuration."""
        self.poses = state["poses"].copy()
        self._motions = state["motions"].copy()
        self._photometry = state["photometry"].copy()
        self._started = state["started"].copy()
        self._blank_frames.colorless = state["colorless"].copy()
        self._lost = state["lost"].copy()
        self._time = state["time"].copy()
        self.map.set_state(state["map"])
        self.relocalisation.set_state(state["relocalisation"])
        self.loops.set_state(state["loops"])
        self._view_poses = None
