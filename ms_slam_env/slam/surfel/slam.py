"""The surfel SLAM: preprocess, track against the map's view, fuse, render the next view.

ElasticFusion (Whelan et al., RSS 2015, figure 2) without loop closure. While tracking is lost the
pose is held, nothing is fused, and every frame is tried against the map around the last good pose.
The view that frames are tracked against shows living surfels of every age: with steps of
centimetres a view seldom lasts until its surfels are stable.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.slam.base import Float64, SlamBackend, TrackResult, Views
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.preprocess import Preprocessor
from ms_slam_env.slam.surfel.seeds import NUM_SEEDS, relocalisation_seeds, tracking_seeds
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracking import Alignment, Tracker
from ms_slam_env.slam.surfel.types import LiveFrame
from ms_slam_env.slam.surfel.verdict import (
    REASONS,
    STAT_INLIER_FRACTION,
    STAT_RESIDUAL_M,
    make_limits,
)

RETRIES = 2  # further searches within a frame whose tracking failed
FEWEST_READINGS = 0.05  # share of the first frame's pixels that must have depth


class BatchedSurfelSlam:
    """The SLAM of B envs in lockstep; each env's results are those it would have alone."""

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str = "cpu"
    ) -> None:
        """Allocate maps and buffers for ``batch`` envs with one camera model."""
        self.batch = batch
        self.intrinsics = intrinsics
        self.config = config
        self.preprocess = Preprocessor(batch, intrinsics, config, device)
        self.tracker = Tracker(batch, NUM_SEEDS, intrinsics, config, device)
        self.map = SurfelMap(batch, intrinsics, config, device)
        self._device_poses = wp.zeros(batch, dtype=wp.mat44, device=device)
        self._device_time = wp.zeros(batch, dtype=wp.int32, device=device)
        self._device_weight = wp.zeros(batch, dtype=wp.float32, device=device)
        self._device_mask = wp.zeros(batch, dtype=wp.int32, device=device)
        self.poses: Float64 = np.tile(np.eye(4), (batch, 1, 1))
        self._motions: Float64 = np.tile(np.eye(4), (batch, 1, 1))
        self._started = np.zeros(batch, dtype=bool)
        self._lost = np.zeros(batch, dtype=np.int32)  # frames since tracking was lost
        self._time = np.zeros(batch, dtype=np.int32)
        self._view = self.map.render_model(self._device_poses)

    def reset(self, T_world_camera: ArrayLike | None = None, env: int = 0) -> None:
        """Forget one env; its next frame is taken at ``T_world_camera`` (identity if None)."""
        pose = np.eye(4) if T_world_camera is None else T_world_camera
        self.poses[env] = check_pose(pose, "T_world_camera")
        self._motions[env] = np.eye(4)
        self._started[env] = False
        self._lost[env] = 0
        self._time[env] = 0
        self.map.clear(env)

    def track(self, color: NDArray[np.uint8], depth: NDArray[np.float32]) -> list[TrackResult]:
        """Track and fuse one frame per env: colour (B, H, W, 3) uint8, depth (B, H, W) metres.

        Raises:
            InputError: another batch or image size; NaN, infinite or negative depth.
        """
        size = (self.batch, *self.intrinsics.shape)
        if color.shape != (*size, 3) or depth.shape != size:
            raise InputError(
                f"colour {color.shape} and depth {depth.shape} must be {(*size, 3)} and {size}"
            )
        if not (depth.min() >= 0 and depth.max() < np.inf):
            raise InputError("depth holds NaN, infinite or negative values; 0 means no reading")
        live = self.preprocess(color, depth)
        results = self._locate(live)
        good = np.array([result.tracking_ok for result in results])
        self._fuse(live, good)
        self._render()
        self._time += 1
        return results

    def _locate(self, live: LiveFrame) -> list[TrackResult]:
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
        alignment = self.tracker.align(self._view, self.poses, seeds, limits)
        alignment = self._search_again(alignment)
        return [
            self._accept(env, alignment) if self._started[env] else self._start(env, live)
            for env in range(self.batch)
        ]

    def _search_again(self, alignment: Alignment) -> Alignment:
        """Give the envs that failed more starting poses, under stricter limits."""
        strict = np.ones(self.batch, dtype=bool)
        for attempt in range(1, 1 + RETRIES):
            failed = self._started & (alignment.verdict != 0)
            if not failed.any():
                break
            seeds = np.stack(
                [relocalisation_seeds(attempt + RETRIES * int(lost)) for lost in self._lost]
            )
            again = self.tracker.align(
                self._view, self.poses, seeds, make_limits(strict, self._lost)
            )
            alignment = alignment.replace(failed & (again.verdict == 0), again)
        return alignment

    def _start(self, env: int, live: LiveFrame) -> TrackResult:
        """Take the first frame at the given pose, if there is something in it to map."""
        readings = float((live.depth[env].numpy() > 0).mean())
        if readings < FEWEST_READINGS:
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
            self._motions[env] = np.eye(4) if relocalised else alignment.T_model_live[env]
            self._lost[env] = 0
        else:
            self._motions[env] = np.eye(4)
            self._lost[env] += 1
        return TrackResult(
            T_world_camera=self.poses[env].copy(),
            tracking_ok=code == 0,
            relocalised=relocalised,
            inlier_fraction=float(alignment.stats[env, STAT_INLIER_FRACTION]),
            residual_m=float(alignment.stats[env, STAT_RESIDUAL_M]),
            reason=REASONS[code],
        )

    def _fuse(self, live: LiveFrame, good: NDArray[np.bool_]) -> None:
        """Fuse the frames with a good pose; a fast camera's readings weigh less."""
        self._device_poses.assign(self.poses.astype(np.float32))
        self._device_time.assign(self._time)
        self._device_weight.assign(motion_weight(self._motions))
        self._device_mask.assign(good.astype(np.int32))
        self.map.fuse(
            live, self._device_poses, self._device_time, self._device_weight, self._device_mask
        )

    def _render(self) -> None:
        """Render the map from the current poses: what the next frame is tracked against."""
        self._device_poses.assign(self.poses.astype(np.float32))
        self._view = self.map.render_model(self._device_poses)

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return {
            "poses": self.poses.copy(),
            "motions": self._motions.copy(),
            "started": self._started.copy(),
            "lost": self._lost.copy(),
            "time": self._time.copy(),
            "map": self.map.get_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of a SLAM of the same batch, intrinsics and configuration."""
        self.poses = state["poses"].copy()
        self._motions = state["motions"].copy()
        self._started = state["started"].copy()
        self._lost = state["lost"].copy()
        self._time = state["time"].copy()
        self.map.set_state(state["map"])
        self._render()


def motion_weight(motions: Float64) -> NDArray[np.float32]:
    """Weights (B,) in [0.5, 1] of frames reached by ``motions`` (B, 4, 4).

    Readings of a fast camera are blurred and skewed; 1 at rest, 0.5 from 0.1 m or 0.1 rad a frame.
    """
    distance = np.linalg.norm(motions[:, :3, 3], axis=1)
    cosine = (np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    size = np.maximum(distance, np.arccos(np.clip(cosine, -1, 1)))
    return np.maximum(0.5, 1 - size / 0.2).astype(np.float32)


class SurfelSlam(SlamBackend):
    """The surfel SLAM of one camera."""

    def __init__(
        self, intrinsics: Intrinsics, config: SurfelConfig | None = None, device: str = "cpu"
    ) -> None:
        """Start empty at the identity pose."""
        self.intrinsics = intrinsics
        self.config = config or SurfelConfig()
        self._slam = BatchedSurfelSlam(1, intrinsics, self.config, device)

    @property
    def map(self) -> SurfelMap:
        """The surfels."""
        return self._slam.map

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""
        self._slam.reset(T_world_camera)

    def track(self, frame: RGBDFrame) -> TrackResult:
        """Estimate the pose of ``frame`` and fuse it into the map.

        Raises:
            InputError: the frame's size is not that of the intrinsics.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        return self._slam.track(frame.color[None], frame.depth[None])[0]

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render the map from ``poses`` (N, 4, 4) T_world_camera at ``scale`` times the size.

        Raises:
            InputError: poses of another shape, or a scale outside (0, 1].
        """
        stack = np.asarray(poses, dtype=np.float64)
        if stack.ndim != 3 or stack.shape[1:] != (4, 4):
            raise InputError(f"poses must have shape (N, 4, 4), got {stack.shape}")
        if not 0 < scale <= 1:
            raise InputError(f"scale = {scale} is outside (0, 1]")
        return self.map.predict(stack, scale)

    def surface_points(self) -> Float64:
        """All living surfels (M, 3): the stable ones and the young ones seen of late.

        Episodes are too short for most surfels to become stable, and the map itself removes
        those that stay unconfirmed.
        """
        return self.map.points(stable=False)

    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``."""
        return self.map.colors(stable=False)

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return self._slam.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self._slam.set_state(state)
