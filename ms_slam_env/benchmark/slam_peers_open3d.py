"""Open3D's dense SLAM (TSDF voxel blocks, hybrid tracking), as a peer of the SLAM backends."""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame

Float64 = NDArray[np.float64]

_DEPTH_SCALE = 5000.0  # 16-bit depth of 0.2 mm, well below the sensor's noise


class Open3DSlam:
    """``open3d.t.pipelines.slam``, called as in Open3D's own example ``dense_slam.py``.

    Raises:
        ImportError: Open3D, or a system library that it needs, is not installed.
    """

    name = "open3d"

    def __init__(
        self,
        intrinsics: Intrinsics,
        voxel_m: float = 0.01,
        max_depth_m: float = 4.0,
        distance_m: float = 0.07,
        truncation_voxels: float = 8.0,
        block_count: int = 40_000,
    ) -> None:
        """Set the camera and the parameters: the example's, but for voxel size and depth range.

        More iterations, a narrower truncation or association do not lower the error with noise.
        """
        import open3d

        open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
        self._open3d = open3d
        self._device = open3d.core.Device("CPU:0")
        matrix = np.eye(3)
        matrix[0, 0], matrix[1, 1] = intrinsics.fx, intrinsics.fy
        matrix[0, 2], matrix[1, 2] = intrinsics.cx, intrinsics.cy
        self._matrix = open3d.core.Tensor.from_numpy(matrix)
        self._shape = intrinsics.shape
        self._voxel_m = voxel_m
        self._max_depth_m = max_depth_m
        self._distance_m = distance_m
        self._truncation = truncation_voxels
        self._block_count = block_count
        self.settings = (
            f"Open3D {open3d.__version__} t.pipelines.slam, hybrid, voxels of {voxel_m:g} m, "
            f"depth up to {max_depth_m:g} m, association within {distance_m:g} m, truncation "
            f"{truncation_voxels:g} voxels"
        )

    def reset(self, T_world_camera: Float64) -> None:
        """Start at a pose (4, 4)."""
        slam = self._open3d.t.pipelines.slam
        core = self._open3d.core
        self._T_world_camera = np.array(T_world_camera, dtype=np.float64)
        self._index = 0
        self._model = slam.Model(
            self._voxel_m,
            16,
            self._block_count,
            core.Tensor.from_numpy(self._T_world_camera),
            self._device,
        )
        self._input = slam.Frame(*self._shape, self._matrix, self._device)
        self._view = slam.Frame(*self._shape, self._matrix, self._device)

    def track(self, frame: RGBDFrame) -> Float64:
        """Estimated T_world_camera (4, 4) of a frame."""
        core = self._open3d.core
        depth = np.rint(frame.depth * _DEPTH_SCALE).astype(np.uint16)[..., None]
        self._input.set_data("depth", core.Tensor.from_numpy(depth))
        self._input.set_data("color", core.Tensor.from_numpy(frame.color))
        if self._index > 0:
            # A singular system raises: tracking failed, and the pose is held.
            with contextlib.suppress(RuntimeError):
                self._T_world_camera = self._T_world_camera @ self._motion()
        self._model.update_frame_pose(self._index, core.Tensor.from_numpy(self._T_world_camera))
        self._model.integrate(self._input, _DEPTH_SCALE, self._max_depth_m, self._truncation)
        self._model.synthesize_model_frame(
            self._view, _DEPTH_SCALE, 0.1, self._max_depth_m, self._truncation, True
        )
        self._index += 1
        return self._T_world_camera

    def _motion(self) -> Float64:
        """T_model_camera (4, 4): the live frame against the view synthesised from the model."""
        odometry = self._open3d.t.pipelines.odometry
        result = self._model.track_frame_to_model(
            self._input,
            self._view,
            _DEPTH_SCALE,
            self._max_depth_m,
            self._distance_m,
            odometry.Method.Hybrid,
        )
        return result.transformation.numpy()
