"""Point cloud odometry of two libraries, small_gicp and KISS-ICP, as backends to compare with.

Both use depth alone and align every frame with their own map of points, from the pose at which the
last motion would continue. As in the libraries, every pose that they return is accepted without
checks; only a frame with too few readings is lost. Frames are also fused into a surfel map at these
poses, so that views and surfaces can be compared. The libraries cannot save their maps, so these
backends have no state.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, orthonormal
from ms_slam_env.slam.shared.alignment_check import NO_ALIGNMENT
from ms_slam_env.slam.shared.tracking_template import Attempt, FrameByFrameSlam
from ms_slam_env.slam.slam_backend import LARGEST_CUTOFF_M, BorrowedMap
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam

_STEP = 1e-4  # radians and metres; a smaller step ends an alignment


@dataclass(frozen=True)
class SmallGicpConfig(Checked):
    """Parameters of scan-to-model VGICP with small_gicp (Koide, JOSS 2024).

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        downsampling_m: voxel size to which a frame's points are thinned.
        voxel_m: size of the map's voxels, each with the distribution of its points.
        correspondence_m: largest distance of a point from its voxel's mean.
        neighbours: number of neighbours used to estimate a point's covariance.
        iterations: most iterations of an alignment.
    """

    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    downsampling_m: float = bounded(0.03, 0.001, 1.0)
    voxel_m: float = bounded(0.1, 0.005, 5.0)
    correspondence_m: float = bounded(0.1, 0.005, 5.0)
    neighbours: int = bounded(10, 5, 100)
    iterations: int = bounded(20, 1, 1000)


@dataclass(frozen=True)
class KissIcpConfig(Checked):
    """Parameters of KISS-ICP (Vizzo et al., RA-L 2023), under the library's names.

    Attributes:
        depth_cutoff_m: readings beyond are ignored.
        voxel_size_m: size of the map's voxels; points are thinned to half of it for the map, and to
            1.5 times it for the alignment.
        max_points_per_voxel: most points of a voxel of the map.
        initial_threshold_m: largest distance of corresponding points, divided by 3, until the
            camera has moved.
        min_motion_m: errors of the predicted motion below this do not change that distance.
    """

    depth_cutoff_m: float = bounded(4.0, 0.1, LARGEST_CUTOFF_M)
    voxel_size_m: float = bounded(0.1, 0.005, 5.0)
    max_points_per_voxel: int = bounded(20, 1, 1000)
    initial_threshold_m: float = bounded(0.1, 0.001, 10.0)
    min_motion_m: float = bounded(0.01, 0.0001, 1.0)


@dataclass(frozen=True)
class Cloud:
    """The readings of a frame as points."""

    points: Float64  # (N, 3) metres, in the camera's frame
    readings: float  # share of the pixels that have depth


class CloudOdometry(BorrowedMap, FrameByFrameSlam[Cloud, None]):
    """Aligns clouds with a library's map of points."""

    def __init__(self, intrinsics: Intrinsics, config: Any) -> None:
        self.config = config
        self._rays = intrinsics.rays()
        kept = SurfelConfig.of_mapper(depth_cutoff_m=config.depth_cutoff_m)
        self._map = SurfelSlam(intrinsics, kept)
        super().__init__(intrinsics)

    @abstractmethod
    def _empty(self) -> None:
        """Empty the library's map."""

    @abstractmethod
    def _register(self, cloud: Cloud, guess: Float64) -> Float64:
        """Align a cloud with the map, from a guess; return T_world_camera (4, 4)."""

    @abstractmethod
    def _insert(self, cloud: Cloud) -> None:
        """Add a cloud to the map at the current pose."""

    @property
    def _has_map(self) -> bool:
        return self._started

    @property
    def _no_attempt(self) -> str:
        return "no pose aligns the frame with the map"

    @property
    def _mapper(self) -> SurfelSlam:
        return self._map

    def _clear(self) -> None:
        self._started = False
        self._map.reset(self._pose)
        self._empty()

    def _prepare(self, frame: RGBDFrame) -> Cloud:
        is_read = (frame.depth > 0) & (frame.depth <= self.config.depth_cutoff_m)
        points = (self._rays * frame.depth[..., None])[is_read].astype(np.float64)
        return Cloud(points, float(is_read.mean()))

    def _attempts(self, prepared: Cloud, guess: Float64 | None) -> Iterator[Attempt[None]]:
        # Made rigid, or rounding errors of the rotation grow from frame to frame.
        start = self._pose @ orthonormal(self._motion) if guess is None else guess
        pose = self._register(prepared, start)
        if np.isfinite(pose).all():
            yield Attempt(pose, NO_ALIGNMENT, "", None)

    def _start_from(self, frame: RGBDFrame, prepared: Cloud) -> None:
        if prepared.readings >= self.fewest_readings:
            self._started = True
            self._insert(prepared)
        self._map.fuse(frame, self._pose)

    def _extend(self, frame: RGBDFrame, prepared: Cloud, attempt: Attempt[None]) -> None:
        self._insert(prepared)
        self._map.fuse(frame, self._pose)

    def get_state(self) -> dict[str, Any]:
        """Not implemented: the libraries cannot restore their maps."""
        raise NotImplementedError(f"{type(self).__name__} cannot save its map")

    def set_state(self, state: dict[str, Any]) -> None:
        """Not implemented, as `get_state`."""
        raise NotImplementedError(f"{type(self).__name__} cannot restore a map")


class SmallGicpSlam(CloudOdometry):
    """VGICP of small_gicp against a voxel map of all earlier frames."""

    config: SmallGicpConfig

    def __init__(self, intrinsics: Intrinsics, config: SmallGicpConfig | None = None) -> None:
        """Start empty at the identity pose."""
        super().__init__(intrinsics, config or SmallGicpConfig())

    def _empty(self) -> None:
        import small_gicp

        self._voxels = small_gicp.GaussianVoxelMap(self.config.voxel_m)
        self._cloud: Cloud | None = None  # the cloud that was thinned last

    def _thinned(self, cloud: Cloud) -> Any:
        import small_gicp

        c = self.config
        return small_gicp.preprocess_points(cloud.points, c.downsampling_m, c.neighbours, 1)[0]

    def _register(self, cloud: Cloud, guess: Float64) -> Float64:
        import small_gicp

        self._cloud, self._source = cloud, self._thinned(cloud)
        found = small_gicp.align(
            self._voxels,
            self._source,
            init_T_target_source=guess,
            max_correspondence_distance=self.config.correspondence_m,
            num_threads=1,  # more threads would not sum in a fixed order
            max_iterations=self.config.iterations,
            rotation_epsilon=_STEP,
            translation_epsilon=_STEP,
        )
        return orthonormal(np.array(found.T_target_source))

    def _insert(self, cloud: Cloud) -> None:
        source = self._source if cloud is self._cloud else self._thinned(cloud)
        self._voxels.insert(source, self._pose)


def load_kiss_icp() -> Any:
    """Import ``kiss_icp``.

    Raises:
        InputError: KISS-ICP is not installed.
    """
    try:
        import kiss_icp.config
        import kiss_icp.kiss_icp
    except ImportError as error:
        raise InputError(
            f"the backend kiss_icp needs KISS-ICP (pip install 'ms-slam-env[peers]'): {error}"
        ) from error
    return kiss_icp


class KissIcpSlam(CloudOdometry):
    """KISS-ICP: point-to-point alignment with an adaptive threshold, against a voxel map.

    The steps are those of its ``register_frame``, without its correction for a turning lidar.
    """

    config: KissIcpConfig

    def __init__(self, intrinsics: Intrinsics, config: KissIcpConfig | None = None) -> None:
        """Start empty at the identity pose."""
        self._library = load_kiss_icp()
        super().__init__(intrinsics, config or KissIcpConfig())

    def _empty(self) -> None:
        c, options = self.config, self._library.config.KISSConfig()
        options.data.max_range, options.data.deskew = c.depth_cutoff_m, False
        options.mapping.voxel_size = c.voxel_size_m
        options.mapping.max_points_per_voxel = c.max_points_per_voxel
        options.adaptive_threshold.initial_threshold = c.initial_threshold_m
        options.adaptive_threshold.min_motion_th = c.min_motion_m
        options.registration.max_num_threads = 1
        self._pipeline = self._library.kiss_icp.KissICP(options)

    def _thinned(self, cloud: Cloud) -> tuple[Float64, Float64]:
        """Points for the alignment, and those for the map."""
        near = self._pipeline.preprocessor.preprocess(cloud.points, np.zeros(0), np.eye(4))
        source, kept = self._pipeline.voxelize(near)
        return source, kept

    def _register(self, cloud: Cloud, guess: Float64) -> Float64:
        pipeline = self._pipeline
        sigma = pipeline.adaptive_threshold.get_threshold()
        pose = pipeline.registration.align_points_to_map(
            points=self._thinned(cloud)[0],
            voxel_map=pipeline.local_map,
            initial_guess=guess,
            max_correspondance_distance=3 * sigma,
            kernel=sigma,
        )
        pipeline.adaptive_threshold.update_model_deviation(invert(guess) @ pose)
        return np.array(pose)

    def _insert(self, cloud: Cloud) -> None:
        self._pipeline.local_map.update(self._thinned(cloud)[1], self._pose)
