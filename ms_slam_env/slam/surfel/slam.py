"""The surfel SLAM of B envs: track a frame against the map's view, fuse it, close loops.

ElasticFusion (Whelan et al., RSS 2015, figure 2). While tracking is lost the pose is held, nothing
is fused, and every frame is tried against the map around the last good pose and around keyframes
that resemble it (``localization``, ``keyframe_search``). The view that frames are tracked against
shows living surfels of every age: with steps of centimetres a view seldom lasts until its surfels
are stable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import check_pose, invert
from ms_slam_env.slam.shared.ferns import Candidate
from ms_slam_env.slam.shared.images import Images, images_of
from ms_slam_env.slam.shared.state import Saved, check_has
from ms_slam_env.slam.slam_backend import TrackResult
from ms_slam_env.slam.surfel.acceptance import Alignment, covariance_at_noise, doubt
from ms_slam_env.slam.surfel.device import SavedBuffer
from ms_slam_env.slam.surfel.free_space_mask import make_motion_mask
from ms_slam_env.slam.surfel.keyframe_search import make_relocalization
from ms_slam_env.slam.surfel.localization import CameraStates, Localizer, MapAligner
from ms_slam_env.slam.surfel.loop_closure import make_loop_closure
from ms_slam_env.slam.surfel.photometry import is_invalid_frame
from ms_slam_env.slam.surfel.pipeline import Pipeline, PipelineCache, check_change
from ms_slam_env.slam.surfel.pose_hypotheses import check_guesses, check_poses, motion_weight
from ms_slam_env.slam.surfel.preprocessing import LiveFrame, count_readings
from ms_slam_env.slam.surfel.rolling_shutter import Shutter
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracked_batch import TrackedBatch, tracked_batch
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
        """Continue with other parameters and frame size; see ``SurfelSlam.reconfigure``."""
        if (config, intrinsics) == (self.config, self.intrinsics):
            return
        check_change(self.config, config, intrinsics != self.intrinsics)
        self.relocalization.adapt(intrinsics, config.depth_cutoff_m)
        if intrinsics != self.intrinsics:
            self.motion_mask.resize(intrinsics)
        self._use(self._pipelines.get(intrinsics, config))

    def _use(self, pipeline: Pipeline) -> None:
        """Process frames and maps with ``pipeline`` from now on."""
        self.intrinsics, self.config = pipeline.intrinsics, pipeline.config
        self.preprocess, self.tracker = pipeline.preprocess, pipeline.tracker
        self._correct_exposure = pipeline.correct_exposure
        self.map.use(pipeline.map_kernels)
        self._localizer.use(pipeline)
        self._shutter.use(self.intrinsics)

    def reset(self, T_world_camera: ArrayLike | None = None, env: int = 0) -> None:
        """Forget one env; its next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self.reset_many(check_pose(pose, "T_world_camera")[None], np.array([env]))

    def reset_many(self, T_world_camera: Float64, envs: NDArray[np.integer[Any]]) -> None:
        """Forget the ``envs`` (N,); their next frames are taken at ``T_world_camera`` (N, 4, 4)."""
        poses = check_poses(T_world_camera, len(envs))
        self._states.reset(envs, poses)
        self._shutter.forget(envs)
        for env in envs.tolist():
            self._last_frames.forget(env)
        self._forget_maps(envs)

    def _forget_maps(self, envs: NDArray[np.integer[Any]]) -> None:
        self.map.clear(envs)
        for env in envs.tolist():
            self.relocalization.clear(env)
            self.loops.reset(env)
            self.motion_mask.forget(env)
        self.aligner.forget_view()

    def track(
        self,
        color: Any,
        depth: Any,
        T_world_camera_guess: Sequence[ArrayLike | None] | None = None,
        times_s: Sequence[float] | None = None,
    ) -> list[TrackResult]:
        """Track and fuse one frame per env, with a result for each; see ``track_arrays``."""
        found = self.track_arrays(color, depth, T_world_camera_guess, times_s)
        return found.results(self.motion_mask.mask)

    def track_arrays(
        self,
        color: Any,
        depth: Any,
        T_world_camera_guess: Sequence[ArrayLike | None] | None = None,
        times_s: Sequence[float] | None = None,
    ) -> TrackedBatch:
        """Track and fuse one frame per env.

        Args:
            color: (B, H, W, 3) uint8; NumPy, or on the device, see ``images_of``: of such images
                only those of envs that are lost, in doubt, or have a new keyframe with features
                come to the host.
            depth: (B, H, W) float32 metres, 0 = no reading; likewise.
            T_world_camera_guess: for every env a pose (4, 4) to start from too, or None.
            times_s: (B,) when the frames were taken, without which no rolling shutter is undone.

        Returns:
            Arrays that are the caller's own.
        """
        guesses = check_guesses(T_world_camera_guess, self.batch)
        taken = images_of(color, depth, self.map.device)
        self._select_surfels(self._states.lost)
        frames = self._shutter.level(taken, self._states.motions)
        live = self.preprocess(frames.color, frames.depth)
        alignment = self._localizer.locate(live, frames, guesses)
        self._shutter.take_time(times_s)
        if self._shutter.is_rolling:
            live, frames, alignment = self._unroll(taken, alignment)
        alignment = covariance_at_noise(alignment, self._states.usual)
        found = self._follow(
            live, alignment, self._states.follow_drift(alignment, self.intrinsics.fx)
        )
        self._correct_exposure(live, self._states.photometry)
        still = Images(frames.color, self.motion_mask.still(frames.depth))
        self._last_frames.keep(still, self.poses, found.tracking_ok)
        self._fuse(live, frames, found.fused)
        return self._close_loops(live, frames, found)

    def can_start(self, color: Any, depth: Any) -> Bool:
        """Which frames (B,) show enough to start a map; images as in ``track_arrays``."""
        images = images_of(color, depth, self.map.device)
        live = self.preprocess(images.color, images.depth)
        enough: Bool = _readings(live, np.ones(self.batch, dtype=bool)) >= FEWEST_READINGS
        return enough

    def start(self, color: Any, depth: Any, where: Bool) -> None:
        """Take the first frames of the envs ``where`` (B,), as ``track`` would; see ``can_start``.

        Those envs were reset and their frames can start a map. The others stay as they are, without
        a frame.
        """
        states = self._states
        frames = images_of(color, depth, self.map.device)
        live = self.preprocess(frames.color, frames.depth)
        self._invalid_frames.find(frames, states.started | ~where)
        states.start(where)
        self._correct_exposure(live, states.photometry)
        self._last_frames.keep(frames, self.poses, where)
        self._fuse(live, frames, where)
        states.count(-(~where).astype(np.int32))

    def fuse(
        self,
        color: Any,
        depth: Any,
        T_world_camera: Float64,
        times_s: Sequence[float] | None = None,
    ) -> list[TrackResult]:
        """Fuse one frame per env at known poses (B, 4, 4), without tracking; see ``track``."""
        poses, states = check_poses(T_world_camera, self.batch), self._states
        motions = np.stack([invert(T) @ pose for T, pose in zip(states.poses, poses, strict=True)])
        motions[~states.started | (states.lost > 0)] = np.eye(4)
        self._shutter.take_time(times_s)
        frames = self._shutter.level(images_of(color, depth, self.map.device), motions)
        live = self.preprocess(frames.color, frames.depth)
        self._select_surfels(np.ones(self.batch, dtype=np.int32))  # known poses: old and new fit
        self._invalid_frames.find(frames, states.started)
        self.motion_mask.expect(live, poses, states.started)
        self.motion_mask.find(poses, states.started)
        states.follow(poses, motions)
        # With too little to see, the first frame that is tracked starts the map.
        states.start(~states.started & (_readings(live, ~states.started) >= FEWEST_READINGS))
        everywhere = np.ones(self.batch, dtype=bool)
        self._last_frames.keep(frames, poses, everywhere)
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
            frames = self._shutter.level(self._last_frames.images, motions)
            live = self.preprocess(frames.color, frames.depth)
            self._forget_maps(np.flatnonzero(where))
            self._states.count(-1)
            self._fuse(live, frames, where)

    def _follow(self, live: LiveFrame, alignment: Alignment, drift: Float64) -> TrackedBatch:
        """Poses of the live frames: given for the first, tracked or searched for the others.

        Where a frame was not tracked the last pose is held. A first frame is taken if there is
        something in it to map.
        """
        states = self._states
        started, lost, doubted = states.started.copy(), states.lost > 0, states.doubted.copy()
        begins = ~started & (_readings(live, ~started) >= FEWEST_READINGS)
        states.start(begins)
        tracked = started & (alignment.tracked | alignment.uncertain)
        states.accept(tracked, alignment, self.config.cauchy_rgb)
        states.hold(started & ~tracked)
        doubts = doubt(1 + doubted)
        return tracked_batch(alignment, started, begins, lost, states.poses, doubts, drift)

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

    def _close_loops(self, live: LiveFrame, frames: Images, found: TrackedBatch) -> TrackedBatch:
        """Close loops after fusion; a closed one corrects the map and the pose, and ``found``."""

        def similar(env: int, before: int) -> list[Candidate]:
            return self.relocalization.similar(env, frames, before)

        closed = self.loops.close(live, self.poses, self._states.time - 1, found.fused, similar)
        for env, (loop, pose) in closed.items():
            found.loops[env] = loop
            if not loop.bent:
                continue
            self._states.move_to(env, pose)
            self._last_frames.move(env, pose)
            self.relocalization.move_keyframes(env, *self.loops.trajectory(env))
            self.motion_mask.forget(env)  # the map and the earlier frames no longer agree
            found.T_world_camera[env], found.loop_closed[env] = pose, True
        return found

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
        """Continue in another map; the camera stays where it is."""
        self.map.set_surfels(env, detached.surfels)
        self.relocalization.set_keyframes(env, detached.keyframes)
        self.loops.set_history(env, detached.history)
        self.aligner.forget_view()

    def restart(self, T_world_camera: Float64, env: int = 0) -> None:
        """Forget an env's map and last frame; track that frame again to start a new map.

        What the recording's noise is stays known, and how far the map has drifted.
        """
        frame, noise = self.last_frame(env), self.noise(env)
        T_old_new, drift = invert(self.poses[env]) @ T_world_camera, self._states.drift[env].copy()
        self.reset(T_world_camera, env)
        self._states.expect_drift(env, T_old_new, drift)
        self._states.set_time(env, frame)
        self.expect_noise(noise, env)

    def noise(self, env: int = 0) -> tuple[np.void, float]:
        """The noise that an env's recording has shown."""
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
        """Index of an env's last frame."""
        return int(self._states.time[env]) - 1

    def mark_lost(self, env: int = 0) -> None:
        """Relocalize an env's next frame in its map, at any exposure."""
        if self._states.started[env]:
            self._states.hold(np.arange(self.batch) == env)
            self._states.forget_exposure(env)
            self.motion_mask.forget(env)

    def motion(self, env: int = 0) -> Float64:
        """Expected motion (4, 4) to an env's next frame."""
        return self._states.motions[env].copy()

    def drift(self, env: int = 0) -> Float64:
        """Covariance (6, 6) of where the map about an env's camera lies in the world."""
        return self._states.drift[env].copy()

    def frames_lost(self, env: int = 0) -> int:
        """Number of frames since an env lost tracking; 0 while tracking."""
        return int(self._states.lost[env])

    def keyframe_poses(self, env: int = 0) -> Float64:
        """Poses (K, 4, 4) of an env's keyframes."""
        return self.relocalization.keyframe_poses(env)

    def shows_something(self, frames: Images, env: int = 0) -> bool:
        """Whether a map could start with an env's frame: it is not blank and has depth."""
        color, depth = frames.of(env)
        blank, readings = is_invalid_frame(color[None])[0], float((depth > 0).mean())
        return readings >= FEWEST_READINGS and (not blank or self._invalid_frames.colorless[env])

    def get_state(self) -> dict[str, Any]:
        """Everything needed to continue bit-exactly, as NumPy arrays."""
        return self._states.get_state() | super().get_state() | self._shutter.get_state()

    def state_like(self) -> Any:
        """See ``Stateful``."""
        own = self._states.state_like(), super().state_like(), self._shutter.state_like()
        return own[0] | own[1] | own[2]

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state of a SLAM of the same batch, intrinsics and configuration."""
        check_has(state, ("map",), "SurfelSlam")
        self.map.check_fits(state["map"])
        self._states.set_state(state)
        super().set_state(state)
        self._shutter.set_state(state)
        self.aligner.forget_view()


def _readings(live: LiveFrame, where: NDArray[np.bool_]) -> Float64:
    """Share of the pixels of frames that have depth (B,); 0 for envs other than ``where`` (B,)."""
    shares = np.zeros(len(where))
    if where.any():
        shares[where] = count_readings(live)[where] / math.prod(live.depth.shape[1:])
    return shares
