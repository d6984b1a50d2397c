"""The surfel SLAM of one camera, as a ``SlamBackend``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.slam.base import Float64, SlamBackend, TrackResult, Views
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.surfel_map import SurfelMap


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

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and fuse it into the map; see ``SlamBackend``.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the guess is no pose.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        return self._slam.track(frame.color[None], frame.depth[None], [T_world_camera_guess])[0]

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` into the map at a known pose (4, 4), without tracking.

        Raises:
            InputError: the frame's size is not that of the intrinsics, or the pose is none.
        """
        self.intrinsics.check_image(frame.depth, "frame")
        pose = check_pose(T_world_camera, "T_world_camera")
        return self._slam.fuse(frame.color[None], frame.depth[None], pose[None])[0]

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

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Colour, normal, radius and confidence of ``surface_points``."""
        names = ("normal", "radius", "confidence")
        living = {name: self.map.attribute(name, stable=False) for name in names}
        return {"color": self.surface_colors(), **living}

    def corrected_trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Fused frames (N,) and their poses (N, 4, 4) as the map has them now; see the base."""
        return self._slam.loops.trajectory(0)

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        return self._slam.get_state()

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that ``get_state`` returned."""
        self._slam.set_state(state)
