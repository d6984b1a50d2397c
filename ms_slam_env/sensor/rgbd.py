"""The RGB-D sensor: poses in, noisy frames or noise-free views out."""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor.bodies import Body, joined
from ms_slam_env.sensor.casters import RayCaster, make_caster
from ms_slam_env.sensor.changes import ChangingLight
from ms_slam_env.sensor.depth_noise import make_depth_noise
from ms_slam_env.sensor.images import Changes, Images, upload_surfaces, upload_tables
from ms_slam_env.sensor.native import frame_key
from ms_slam_env.sensor.noise import NoiseConfig, noise_config
from ms_slam_env.sensor.rays import make_pinhole
from ms_slam_env.sensor.shading import Surfaces

FRAME_RATE_HZ = 30.0
"""Rate of the simulated sensor; sets a frame's time stamp if the caller gives none."""

ROLLING_ROWS = 2
"""Number of rows that a rolling shutter exposes together."""


@dataclass(frozen=True)
class TrueView:
    """What an ideal sensor sees from one pose.

    Attributes:
        color: (H, W, 3) uint8 without noise.
        depth: (H, W) float32 metres along the optical axis; 0 = no surface.
        normals: (H, W, 3) float32 unit vectors in the camera frame, facing the camera; 0 = none.
        labels: (H, W) int32 index into the mesh's labels; -1 = no surface.
        points: (H, W, 3) float32 in the world frame; 0 = no surface.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    labels: NDArray[np.int32]
    points: NDArray[np.float32]


_BATCH_SIZES_KEPT = 8  # buffers for one image of 160x120 take half a megabyte


class _OfThread(threading.local):
    """Per-thread data of a sensor."""

    def __init__(self) -> None:
        self.images: dict[tuple[int, bool], Images] = {}  # by number of images, rolling or not
        self.last: Images | None = None


_RECORDING = threading.Lock()  # Warp loads and records kernels one at a time


class RGBDSensor:
    """A colour and depth camera in a scene.

    The noise of a frame is a function of (seed, index, pixel) alone: the order of calls and the
    batch of a frame do not matter. Several threads may use one sensor; each has its own buffers.
    """

    def __init__(
        self,
        scene: Scene,
        intrinsics: Intrinsics,
        noise: str | NoiseConfig = "kinect",
        seed: int = 0,
        device: str = "cpu",
        caster: RayCaster | None = None,
        bodies: Sequence[Body] = (),
        light: ChangingLight | None = None,
    ) -> None:
        """Prepare to render ``scene``.

        Args:
            scene: the world; its mesh is copied to the device once.
            intrinsics: intrinsics of both images, which are registered; distortion applies to both.
            noise: "kinect", "none" or a NoiseConfig.
            seed: noise seed.
            device: Warp device, such as "cpu" or "cuda:0".
            caster: ray caster; by default the fastest one for the device.
            bodies: moving bodies, placed according to the frame's time.
            light: how the scene's light changes; None leaves it constant.

        Raises:
            InputError: unknown noise model, or a seed that is not an integer >= 0.
        """
        self.scene = scene
        self.intrinsics = intrinsics
        self.noise = noise_config(noise)
        self.seed = seed
        frame_key(seed, 0)
        self.device = device
        self._caster = caster or make_caster(scene.mesh, device)
        self._cameras = {
            False: make_pinhole(intrinsics, device=device),
            True: make_pinhole(intrinsics, ROLLING_ROWS, device),
        }
        self._depth_noise = make_depth_noise(self.noise, intrinsics)
        mesh = joined(scene.mesh, bodies) if bodies else scene.mesh
        self.labels: tuple[str, ...] = mesh.labels
        self._surfaces = upload_surfaces(mesh, device)
        self._changes = None
        if bodies or light is not None:
            casters = [make_caster(body.mesh, device) for body in bodies]
            self._changes = Changes(mesh, tuple(bodies), casters, light)
        self._tables = upload_tables(device)
        self._of_thread = _OfThread()

    def capture(
        self,
        T_world_camera: ArrayLike,
        index: int,
        timestamp: float | None = None,
        seed: int | None = None,
    ) -> RGBDFrame:
        """Take frame ``index`` from pose ``T_world_camera`` (4, 4).

        Args:
            T_world_camera: pose of the camera.
            index: noise counter: the same index and seed give the same noise.
            timestamp: seconds; index / 30 Hz by default.
            seed: noise seed; the sensor's own by default.

        Raises:
            InputError: a pose that is not a finite rigid motion, or a bad index or seed.
        """
        poses = np.asarray(T_world_camera, dtype=np.float64)[None]
        times = None if timestamp is None else [timestamp]
        return self.capture_batch(poses, [index], seed, times)[0]

    def capture_batch(
        self,
        T_world_camera: ArrayLike,
        indices: Sequence[int] | NDArray[np.integer],
        seed: int | None = None,
        timestamps: Sequence[float] | NDArray[np.floating] | None = None,
    ) -> list[RGBDFrame]:
        """Take frames ``indices`` (B,) from poses (B, 4, 4) at once.

        Args:
            T_world_camera: poses of the camera.
            indices: noise counters, one per pose.
            seed: noise seed; the sensor's own by default.
            timestamps: (B,) seconds; index / 30 Hz by default.

        Raises:
            InputError: a pose that is not a finite rigid motion, a bad index, seed or time stamp,
                or a number of indices or time stamps that differs from that of the poses.
        """
        poses = np.asarray(T_world_camera, dtype=np.float64)
        if len(poses) != len(indices) or len(poses) == 0:
            raise InputError(f"{len(indices)} frame indices for poses of shape {poses.shape}")
        for pose in poses:
            check_pose(pose, "T_world_camera")
        noise_seed = self.seed if seed is None else seed
        keys = np.stack([frame_key(noise_seed, index) for index in indices])
        times = _frame_times(indices, timestamps)
        if self._changes is not None and len(poses) > 1:
            return [
                self.capture(pose, index, time, noise_seed)
                for pose, index, time in zip(poses, indices, times, strict=True)
            ]
        images = self._images(len(poses))
        colors, depths = images.capture(poses, keys, np.array(times))
        self._of_thread.last = images
        return [RGBDFrame(colors[b].copy(), depths[b].copy(), time) for b, time in enumerate(times)]

    @property
    def rolling_poses(self) -> int:
        """Number of poses per rolling-shutter image: one for every two rows."""
        return -(-self.intrinsics.height // ROLLING_ROWS)

    def capture_rolling(
        self,
        T_world_camera: ArrayLike,
        index: int,
        timestamp: float | None = None,
        seed: int | None = None,
        row_times_s: ArrayLike | None = None,
    ) -> RGBDFrame:
        """Take frame ``index`` with a rolling shutter: every two rows have their own pose.

        With equal poses it is the frame of ``capture``, bit for bit.

        Args:
            T_world_camera: (rolling_poses, 4, 4), from the top row to the bottom.
            index: noise counter.
            timestamp: seconds; index / 30 Hz by default.
            seed: noise seed; the sensor's own by default.
            row_times_s: (rolling_poses,) seconds, for moving bodies and changing light; the time
                stamp by default.

        Raises:
            InputError: a wrong number of poses or times, a pose that is not a finite rigid motion,
                or a bad index, seed or time stamp.
        """
        poses = self._check_rolling(np.asarray(T_world_camera, dtype=np.float64)[None])
        keys = frame_key(self.seed if seed is None else seed, index)[None]
        time = _frame_times([index], None if timestamp is None else [timestamp])[0]
        images = self._images(1, is_rolling=True)
        colors, depths = images.capture(poses, keys, _times_of(row_times_s, len(poses), time))
        self._of_thread.last = images
        return RGBDFrame(colors[0].copy(), depths[0].copy(), time)

    def ideal_colors(
        self, T_world_camera: ArrayLike, times_s: ArrayLike | None = None
    ) -> NDArray[np.uint8]:
        """Noise-free colour (B, H, W, 3) from poses (B, rolling_poses, 4, 4).

        One pose for every two rows, as in ``capture_rolling``; ``times_s`` (B, rolling_poses) are
        the times for moving bodies and changing light.

        Raises:
            InputError: a wrong shape, or a pose that is not a finite rigid motion.
        """
        poses = np.asarray(T_world_camera, dtype=np.float64)
        flat = self._check_rolling(poses)
        times = _times_of(times_s, len(flat), 0.0)
        if self._changes is None:
            return self._images(len(poses), is_rolling=True).ideal_colors(flat).copy()
        images = self._images(1, is_rolling=True)
        each = zip(poses, times.reshape(len(poses), -1), strict=True)
        return np.concatenate([images.ideal_colors(*one).copy() for one in each])

    def _check_rolling(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Check poses (B, rolling_poses, 4, 4), and flatten them to (B * rolling_poses, 4, 4)."""
        if poses.ndim != 4 or poses.shape[1:] != (self.rolling_poses, 4, 4) or len(poses) == 0:
            raise InputError(
                f"a rolling shutter of {self.intrinsics.height} rows needs poses "
                f"({self.rolling_poses}, 4, 4), got shape {poses.shape[1:]}"
            )
        flat = poses.reshape(-1, 4, 4)
        R = flat[:, :3, :3]
        is_rigid = (  # all at once; one by one would cost more than rendering
            (np.abs(R @ R.swapaxes(1, 2) - np.eye(3)) < 1e-4).all()
            and (np.linalg.det(R) > 0).all()
            and (flat[:, 3] == (0, 0, 0, 1)).all()
            and np.isfinite(flat).all()
        )
        for pose in flat if not is_rigid else ():
            check_pose(pose, "T_world_camera")
        return flat

    def with_noise(self, noise: str | NoiseConfig) -> RGBDSensor:
        """Copy this sensor with another noise model; both share the scene's data.

        Raises:
            InputError: unknown noise model.
        """
        made = copy.copy(self)
        made.noise = noise_config(noise)
        made._depth_noise = make_depth_noise(made.noise, self.intrinsics)
        made._of_thread = _OfThread()
        return made

    @property
    def caster(self) -> RayCaster:
        """The ray caster."""
        return self._caster

    @property
    def surfaces(self) -> Surfaces:
        """What shading needs of the scene's mesh."""
        return self._surfaces

    def last_true_depth(self, moving: bool = True) -> NDArray[np.float32]:
        """True depth (H, W) of the frame that this thread captured last, metres; 0 = no surface.

        Unless ``moving``, moving bodies count as no surface. Needs no second ray cast. Later
        captures of this sensor in the same thread overwrite it.

        Raises:
            InputError: nothing was captured yet.
        """
        if self._of_thread.last is None:
            raise InputError("the sensor has captured no frame yet")
        return self._of_thread.last.true_depth(moving)[-1]

    def ground_truth(self, T_world_camera: ArrayLike, time_s: float = 0.0) -> TrueView:
        """Noise-free view from pose ``T_world_camera`` (4, 4) at ``time_s``.

        Raises:
            InputError: a pose that is not a finite rigid motion.
        """
        pose = check_pose(T_world_camera, "T_world_camera")
        color, depth, normals, labels, points = self._images(1).truth(
            pose[None], np.array([time_s])
        )
        return TrueView(color[0], depth[0], normals[0], labels[0], points[0])

    def _images(self, batch: int, is_rolling: bool = False) -> Images:
        """This thread's buffers for ``batch`` images."""
        images = self._of_thread.images.get((batch, is_rolling))
        if images is None:
            with _RECORDING:
                images = Images(
                    (batch, *self.intrinsics.shape),
                    self._cameras[is_rolling],
                    self._caster,
                    self._surfaces,
                    self._tables,
                    self.noise,
                    self._depth_noise,
                    self.scene.exposure,
                    self.device,
                    self._changes,
                )
            kept = self._of_thread.images
            if len(kept) == _BATCH_SIZES_KEPT:
                kept.pop(next(iter(kept)))
            kept[batch, is_rolling] = images
        return images


def _times_of(times_s: ArrayLike | None, count: int, default: float) -> NDArray[np.float64]:
    """Times (count,) of the poses."""
    if times_s is None:
        return np.full(count, default)
    times = np.asarray(times_s, dtype=np.float64).ravel()
    if len(times) != count:
        raise InputError(f"{len(times)} times for {count} poses")
    return times


def _frame_times(
    indices: Sequence[int] | NDArray[np.integer],
    timestamps: Sequence[float] | NDArray[np.floating] | None,
) -> list[float]:
    """Time of each frame in seconds."""
    if timestamps is None:
        return [float(index) / FRAME_RATE_HZ for index in indices]
    if len(timestamps) != len(indices):
        raise InputError(f"{len(timestamps)} time stamps for {len(indices)} frames")
    times = [float(timestamp) for timestamp in timestamps]
    if not all(math.isfinite(time) for time in times):
        raise InputError(f"time stamps must be finite, got {times}")
    return times
