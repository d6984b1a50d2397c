"""The surfel SLAM of B envs: track a frame against the map's view, fuse it, close loops.

ElasticFusion (Whelan et al., RSS 2015, figure 2). While tracking is lost the pose is held, nothing
is fused, and every frame is tried against the map around the last good pose and around keyframes
that resemble it (``localization``, ``keyframe_search``). The view that frames are tracked against
shows living surfels of every age: with steps of centimetres a view seldom lasts until its surfels
are stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import check_pose, invert
from ms_slam_env.slam.shared.alignment_check import MAP_REASONS, TrackingStatus
from ms_slam_env.slam.shared.ferns import Candidate
from ms_slam_env.slam.shared.state import Saved, check_has
from ms_slam_env.slam.slam_backend import TrackResult
from ms_slam_env.slam.surfel.acceptance import Alignment, with_doubt
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.free_space_mask import make_motion_mask
from ms_slam_env.slam.surfel.keyframe_search import Images, make_relocalization
from ms_slam_env.slam.surfel.localization import CameraStates, Localizer, MapAligner
from ms_slam_env.slam.surfel.loop_closure import make_loop_closure
from ms_slam_env.slam.surfel.photometry import is_invalid_frame
from ms_slam_env.slam.surfel.pipeline import Pipeline, PipelineCache, check_change
from ms_slam_env.slam.surfel.pose_hypotheses import check_guesses, check_poses, motion_weight
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rolling_shutter import Shutter
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracker import model_stride
from ms_slam_env.slam.surfel.trajectory_history import DetachedMap

FEWEST_READINGS = 0.05  # share of the first frame's pixels that must have depth


class BatchedSurfelSlam(Saved):
    """The SLAM of B envs in lockstep; each env's results are those it would have alone."""

    saved = ("_invalid_frames", "map", "relocalization", "loops", "motion_mask", "_last_frames")

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str = "cpu"
    ) -> None:
        self.batch = batch
        self.map = SurfelMap(batch, intrinsics, config, device, model_stride(intrinsics, config))
        self._pipelines = PipelineCache(self.map)
        self.loops = make_loop_closure(self.map, config, device)
        self.relocalization = make_relocalization(batch, intrinsics, config)
        self._states = CameraStates(batch)
        self.motion_mask = make_motion_mask(batch, intrinsics, config, device)
        self._shutter = Shutter(batch, config.readout_s, device)
        self.aligner = MapAligner(self._states, self.map, self.motion_mask)
        parts = self._states, self.aligner, self.relocalization, self.motion_mask
        self._localizer = Localizer(*parts, intrinsics)
        self._invalid_frames = self._localizer.invalid_frames
        self._last_frames = self._localizer.last_frames
        dtypes = (wp.mat44, wp.int32, wp.float32, wp.int32)  # of pose, time, weight and mask
        self._fused = [SavedBuffer(batch, dtype, device) for dtype in dtypes]
        self._use(self._pipelines.get(intrinsics, config))

    @property
    def poses(self) -> Float64:
        """Estimated poses (B, 4, 4) T_world_camera."""
        return self._states.poses

    def reconfigure(self, config: SurfelConfig, intrinsics: Intrinsics) -> None:
        """Go on with other parameters and frame size; see ``SurfelSlam.reconfigure``."""
        if (config, intrinsics) == (self.config, self.intrinsics):
            return
        check_change(self.config, config, intrinsics != self.intrinsics)
        self.relocalization.adapt(intrinsics, config.depth_cutoff_m)
        if intrinsics != self.intrinsics:
            self.motion_mask.resize(intrinsics)
        self._use(self._pipelines.get(intrinsics, config))

    def _use(self, pipeline: Pipeline) -> None:
        """Look at frames, and at the maps, in this way from now on."""
        self.intrinsics, self.config = pipeline.intrinsics, pipeline.config
        self.preprocess, self.tracker = pipeline.preprocess, pipeline.tracker
        self._correct_exposure = pipeline.correct_exposure
        self.map.use(pipeline.map_kernels)
        self._localizer.use(pipeline)
        self._shutter.use(self.intrinsics)

    def reset(self, T_world_camera: ArrayLike | None = None, env: int = 0) -> None:
        """Forget one env; its next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self._states.reset(env, check_pose(pose, "T_world_camera"))
        self._last_frames.forget(env)
        self._shutter.forget(env)
        self._forget_map(env)

    def _forget_map(self, env: int) -> None:
        self.map.clear(env)
        self.relocalization.clear(env)
        self.loops.reset(env)
        self.motion_mask.forget(env)
        self.aligner.forget_view()

    def track(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        T_world_camera_guess: Sequence[ArrayLike | None] | None = None,
        times_s: Sequence[float] | None = None,
    ) -> list[TrackResult]:
        """Track and fuse one frame per env: colour (B, H, W, 3) uint8, depth (B, H, W) metres.

        ``T_world_camera_guess`` holds for every env a pose (4, 4) to start from too, or None;
        ``times_s`` says when the frames were taken, without which no rolling shutter is undone.
        """
        guesses = check_guesses(T_world_camera_guess, self.batch)
        self._select_surfels(self._states.lost)
        taken = Images(color, depth)
        frames = self._shutter.level(taken, self._states.motions)
        live = self.preprocess(frames.color, frames.depth)
        alignment = self._localizer.locate(live, frames, guesses)
        self._shutter.take_time(times_s)
        if self._shutter.is_rolling:
            live, frames, alignment = self._unroll(taken, alignment)
        results = [self._follow(env, live, alignment) for env in range(self.batch)]
        self._correct_exposure(live, self._states.photometry)
        known = np.array([result.tracking_ok for result in results])
        self._last_frames.keep(
            frames.color, self.motion_mask.still(frames.depth), self.poses, known
        )
        self._fuse(live, frames, np.array([result.fused for result in results]))
        return self._close_loops(live, frames, results)

    def can_start(self, color: NDArray[np.uint8], depth: NDArray[np.float32]) -> Bool:
        """Which frames (B,) show enough to start a map: colour (B, H, W, 3), depth (B, H, W)."""
        live = self.preprocess(color, depth)
        shares = (live.depth.numpy() > 0).reshape(self.batch, -1).mean(axis=1)
        enough: Bool = shares >= FEWEST_READINGS
        return enough

    def start(self, color: NDArray[np.uint8], depth: NDArray[np.float32], where: Bool) -> None:
        """Take the first frames of the envs ``where`` (B,), as ``track`` would; see ``can_start``.

        Those envs were reset and their frames can start a map. The others stay as they are, without
        a frame.
        """
        states = self._states
        frames = Images(color, depth)
        live = self.preprocess(color, depth)
        self._invalid_frames.find(color, states.started | ~where)
        for env in np.flatnonzero(where):
            states.start(int(env))
        self._correct_exposure(live, states.photometry)
        self._last_frames.keep(color, depth, self.poses, where)
        self._fuse(live, frames, where)
        states.count(-(~where).astype(np.int32))

    def fuse(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        T_world_camera: Float64,
        times_s: Sequence[float] | None = None,
    ) -> list[TrackResult]:
        """Fuse one frame per env at known poses (B, 4, 4), without tracking; see ``track``."""
        poses, states = check_poses(T_world_camera, self.batch), self._states
        motions = np.stack([invert(T) @ pose for T, pose in zip(states.poses, poses, strict=True)])
        motions[~states.started | (states.lost > 0)] = np.eye(4)
        self._shutter.take_time(times_s)
        frames = self._shutter.level(Images(color, depth), motions)
        live = self.preprocess(frames.color, frames.depth)
        self._select_surfels(np.ones(self.batch, dtype=np.int32))  # known poses: old and new fit
        self._invalid_frames.find(frames.color, states.started)
        self.motion_mask.expect(live, poses, states.started)
        self.motion_mask.find(poses, states.started)
        states.follow(poses, motions)
        for env in np.flatnonzero(~states.started):
            # With too little to see, the first frame that is tracked starts the map.
            if _readings(int(env), live) >= FEWEST_READINGS:
                states.start(int(env))
        everywhere = np.ones(self.batch, dtype=bool)
        self._last_frames.keep(frames.color, frames.depth, poses, everywhere)
        self._fuse(live, frames, everywhere)
        return [
            TrackResult(pose.copy(), True, moving=self.motion_mask.mask(env))
            for env, pose in enumerate(poses)
        ]

    def _select_surfels(self, lost: NDArray[np.int32]) -> None:
        """Let loop closure choose what frames are aligned with and fused into."""
        if self.loops.select(lost):
            self.aligner.forget_view()

    def _unroll(self, taken: Images, alignment: Alignment) -> tuple[LiveFrame, Images, Alignment]:
        """Level frames by the motions that were found, and align them once more."""
        states = self._states
        moved = states.started & alignment.tracked & (states.lost == 0)
        motions = np.where(moved[:, None, None], alignment.T_model_live, np.eye(4))
        self._map_first_again(motions, moved & (states.time == 1))
        frames = self._shutter.level(taken, motions)
        live = self.preprocess(frames.color, frames.depth)
        return live, frames, self.aligner.realign(live, alignment, moved)

    def _map_first_again(self, motions: Float64, where: NDArray[np.bool_]) -> None:
        """Map the first frames of the envs ``where`` (B,) as levelled by the motions since."""
        if where.any():
            frames = self._shutter.level(Images(*self._last_frames.images), motions)
            live = self.preprocess(frames.color, frames.depth)
            for env in np.flatnonzero(where):
                self._forget_map(int(env))
            self._states.count(-1)
            self._fuse(live, frames, where)

    def _follow(self, env: int, live: LiveFrame, alignment: Alignment) -> TrackResult:
        """Pose of a live frame: given for the first, tracked or searched for the others."""
        started = self._states.started[env]
        return self._move_on(env, alignment) if started else self._start(env, live)

    def _start(self, env: int, live: LiveFrame) -> TrackResult:
        """Take the first frame at the given pose, if there is something in it to map."""
        pose = self.poses[env].copy()
        if _readings(env, live) < FEWEST_READINGS:
            reason = "the first frame has too few depth readings"
            return TrackResult(pose, False, inlier_fraction=0.0, reason=reason, overlap=0.0)
        self._states.start(env)
        return TrackResult(pose, True, moving=self.motion_mask.mask(env))

    def _move_on(self, env: int, alignment: Alignment) -> TrackResult:
        """Take the pose of a frame that was tracked, else hold the last one."""
        status, states = TrackingStatus(alignment.status[env]), self._states
        uncertain = status == TrackingStatus.UNCERTAIN
        tracked = uncertain or status == TrackingStatus.OK
        covariance = alignment.covariance[env]
        if uncertain:
            covariance = with_doubt(covariance, 1 + int(states.doubted[env]))
        relocalised = tracked and bool(states.lost[env])
        if tracked:
            states.accept(env, alignment, self.config.cauchy_rgb)
        else:
            states.hold(env)
        return TrackResult(
            T_world_camera=states.poses[env].copy(),
            tracking_ok=tracked,
            relocalised=relocalised,
            inlier_fraction=float(alignment.statistics[env]["inlier_ratio"]),
            residual_m=float(alignment.statistics[env]["residual_m"]),
            reason=MAP_REASONS[status],
            degenerate_directions=int(alignment.statistics[env]["degenerate_directions"]),
            covariance=covariance if tracked else None,
            uncertain=uncertain,
            overlap=float(alignment.statistics[env]["overlap"]),
            moving=self.motion_mask.mask(env),
        )

    def _fuse(self, live: LiveFrame, frames: Images, good: NDArray[np.bool_]) -> None:
        """Fuse the frames with a good pose; a fast camera's readings weigh less."""
        states = self._states
        self.relocalization.add_keyframes(frames, states.poses, states.time, good)
        self.motion_mask.remember(live, states.poses, good)
        if good.any():
            weights = motion_weight(states.motions)
            values: list[NDArray[Any]] = [states.poses, states.time, weights, good]
            for buffer, value in zip(self._fused, values, strict=True):
                buffer.write(value)
            self.map.fuse(live, *(buffer.array for buffer in self._fused))
            self.loops.record(states.poses, states.time, good)
            self.aligner.forget_view()
        states.count()

    def _close_loops(
        self, live: LiveFrame, frames: Images, results: list[TrackResult]
    ) -> list[TrackResult]:
        """Close loops after fusion; a closed one corrects the map and the pose."""

        def similar(env: int, before: int) -> list[Candidate]:
            return self.relocalization.similar(env, frames, before)

        tracked = np.array([result.fused for result in results])
        closed = self.loops.close(live, self.poses, self._states.time - 1, tracked, similar)
        for env, (loop, pose) in closed.items():
            results[env] = replace(results[env], loop=loop)
            if not loop.bent:
                continue
            self._states.move_to(env, pose)
            self._last_frames.move(env, pose)
            self.relocalization.move_keyframes(env, *self.loops.trajectory(env))
            self.motion_mask.forget(env)  # the map and the earlier frames no longer agree
            results[env] = replace(results[env], T_world_camera=pose.copy(), loop_closed=True)
        return results

    # -- Maps that come and go ---------------------------------------------------------------

    def detach_map(self, label: int, env: int = 0) -> DetachedMap:
        """A copy of what an env has mapped until now, as submap ``label``."""
        return DetachedMap(
            self.map.get_surfels(env),
            self.relocalization.get_keyframes(env),
            self.loops.get_history(env),
            label,
            self.last_frame(env),
        )

    def attach_map(self, detached: DetachedMap, env: int = 0) -> None:
        """Go on with another map; the camera stays where it is."""
        self.map.set_surfels(env, detached.surfels)
        self.relocalization.set_keyframes(env, detached.keyframes)
        self.loops.set_history(env, detached.history)
        self.aligner.forget_view()

    def restart(self, T_world_camera: Float64, env: int = 0) -> None:
        """Forget an env's map and its last frame, which is to be taken first of a new one.

        What the recording's noise is stays known.
        """
        frame, noise = self.last_frame(env), self.noise(env)
        self.reset(T_world_camera, env)
        self._states.set_time(env, frame)
        self.expect_noise(noise, env)

    def noise(self, env: int = 0) -> tuple[np.void, float]:
        """What an env's recording has shown of its noise."""
        return self._states.noise(env)

    def expect_noise(self, noise: tuple[np.void, float], env: int = 0) -> None:
        """Judge an env's frames by the ``noise`` of another SLAM of the recording."""
        self._states.expect_noise(env, *noise)

    def move_camera(self, T: Float64, env: int = 0) -> None:
        """Move an env's camera by ``T`` (4, 4) of the world."""
        self._states.move_to(env, T @ self.poses[env])
        self.motion_mask.forget(env)
        self._last_frames.move(env, self.poses[env])

    def last_frame(self, env: int = 0) -> int:
        """Number of an env's last frame."""
        return int(self._states.time[env]) - 1

    def mark_lost(self, env: int = 0) -> None:
        """Seek an env's next frame in its map, whatever the light is by now."""
        if self._states.started[env]:
            self._states.hold(env)
            self._states.forget_exposure(env)
            self.motion_mask.forget(env)

    def motion(self, env: int = 0) -> Float64:
        """Motion (4, 4) that is expected of an env's next frame."""
        return self._states.motions[env].copy()

    def frames_lost(self, env: int = 0) -> int:
        """Frames since an env's tracking was lost; 0: it is not."""
        return int(self._states.lost[env])

    def keyframe_poses(self, env: int = 0) -> Float64:
        """Poses (K, 4, 4) of an env's keyframes."""
        return self.relocalization.keyframe_poses(env)

    def shows_something(self, frames: Images, env: int = 0) -> bool:
        """Whether a map could start with an env's frame: it is not blank and has depth."""
        blank = is_invalid_frame(frames.color[env : env + 1])[0]
        readings = float((frames.depth[env] > 0).mean())
        return readings >= FEWEST_READINGS and (not blank or self._invalid_frames.colorless[env])

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return self._states.get_state() | super().get_state() | self._shutter.get_state()

    def state_like(self) -> Any:
        """See ``Stateful``."""
        own = self._states.state_like(), super().state_like(), self._shutter.state_like()
        return own[0] | own[1] | own[2]

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of a SLAM of the same batch, intrinsics and configuration."""
        check_has(state, ("map",), "SurfelSlam")
        self.map.check_fits(state["map"])
        self._states.set_state(state)
        super().set_state(state)
        self._shutter.set_state(state)
        self.aligner.forget_view()


def _readings(env: int, live: LiveFrame) -> float:
    """Share of a frame's pixels that have depth."""
    return float((live.depth[env].numpy() > 0).mean())
