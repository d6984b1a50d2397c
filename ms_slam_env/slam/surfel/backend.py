"""The surfel SLAM of one camera, as a ``SlamBackend``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame, check_frame
from ms_slam_env.camera.frame import reduce_color, reduce_depth
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.state import check_has
from ms_slam_env.slam.shared.submap_frames import Submaps
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult, Views, check_views
from ms_slam_env.slam.surfel.color_cameras import EstimatedColorCamera
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam
from ms_slam_env.slam.surfel.submaps import AtlasSubmaps
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig
from ms_slam_env.slam.surfel.surfel_map import SurfelMap


class SurfelSlam(SlamBackend):
    """The surfel SLAM of one camera."""

    def __init__(
        self, intrinsics: Intrinsics, config: SurfelConfig | None = None, device: str = "cpu"
    ) -> None:
        self.intrinsics = intrinsics
        self.device = device
        self._slam = BatchedSurfelSlam(1, intrinsics, config or SurfelConfig(), device)
        self._submaps = AtlasSubmaps(self._slam)
        is_estimated = self.config.color_registration == "estimated"
        self._color_camera = EstimatedColorCamera() if is_estimated else None

    @property
    def config(self) -> SurfelConfig:
        """The parameters in force."""
        return self._slam.config

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) to which frames are reduced; the camera's own unless reconfigured."""
        return self._slam.intrinsics.width, self._slam.intrinsics.height

    def reconfigure(self, config: SurfelConfig, image_size: tuple[int, int] | None = None) -> None:
        """Continue with other parameters; keep the map, pose, motion and keyframes.

        Setting the present parameters again changes no bit of the results. The state of
        ``get_state`` does not hold the parameters: restore it with the same ones in force.

        Args:
            config: the new parameters; those in ``pipeline.FIXED`` must not change. Loop closure
                keeps the parameters that it was made with, and ferns keep their depth range.
            image_size: (width, height) to which frames are reduced first; None keeps their size.
                ``track`` still takes frames of the camera's own size, and ``predict`` still renders
                views of that size. A new size resets the motion mask and the features of the last
                frame.

        Raises:
            InputError: a fixed parameter changes, or frames cannot be reduced to ``image_size``.
        """
        own = self.intrinsics
        width, height = image_size or (own.width, own.height)
        if width > own.width or width * own.height != own.width * height or width < 1:
            raise InputError(
                f"frames of {own.width}x{own.height} cannot be reduced to {width}x{height}"
            )
        reduced = own if width == own.width else own.scaled(width / own.width)
        self._slam.reconfigure(config, reduced)

    @property
    def map(self) -> SurfelMap:
        """The surfels of the present submap and of all submaps joined to it."""
        return self._slam.map

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame has the pose ``T_world_camera`` (identity if None)."""
        self._slam.reset(T_world_camera)
        self._submaps.reset()
        if self._color_camera is not None:
            self._color_camera.reset(T_world_camera)

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and fuse it into the map; see ``SlamBackend``."""
        color, depth = self._images(frame)
        guess, time_s = T_world_camera_guess, frame.timestamp
        if self._color_camera is None:
            result = self._slam.track(color, depth, [guess], [time_s])[0]
        else:
            result = self._color_camera.track(self._slam, color, depth, guess, time_s)
        return self._submaps.follow(Images(color, depth), guess, result)

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` into the map at a known pose (4, 4), without tracking."""
        color, depth = self._images(frame)
        pose = check_pose(T_world_camera, "T_world_camera")
        return self._slam.fuse(color, depth, pose[None], [frame.timestamp])[0]

    def _images(self, frame: RGBDFrame) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour (1, h, w, 3) and depth (1, h, w) at ``image_size``."""
        check_frame(frame, self.intrinsics)
        color, depth = frame.color, frame.depth
        if self._slam.intrinsics != self.intrinsics:
            size = self.image_size
            color, depth = reduce_color(color, size), reduce_depth(depth, size)
        color, depth = color[None], depth[None]
        if self._color_camera is not None:
            color = self._color_camera.registered(self._slam, color, depth)
        return color, depth

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render the map from ``poses`` (N, 4, 4) T_world_camera at ``scale`` times image size."""
        return self.map.predict(check_views(poses, scale), scale)

    def project(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """As ``predict``, with all surfels splatted into every view instead of one view warped."""
        return self.map.predict(check_views(poses, scale), scale, singly=True)

    def surface_points(self) -> Float64:
        """Positions (M, 3) of all living surfels: stable ones, and young ones seen recently.

        Young ones count because episodes are too short for most surfels to become stable; the map
        removes those that stay unconfirmed. Surfels of the present submap come first, then those
        of submaps that are not joined to it, placed by the best guess.
        """
        return self._living("position").astype(np.float64)

    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``."""
        return np.clip(np.rint(self._living("color")), 0, 255).astype(np.uint8)

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Colour, normal, radius, confidence and submap of ``surface_points``."""
        living = {name: self._living(name) for name in ("normal", "radius", "confidence")}
        attributes: dict[str, NDArray[Any]] = {"color": self.surface_colors(), **living}
        detached = self._submaps.detached
        if detached:
            labels = [self._submaps.present, *(each.label for each in detached)]
            counts = [self.map.count(), *(int(each.living.sum()) for each in detached)]
            attributes["submap"] = np.repeat(np.array(labels, dtype=np.int32), counts)
        return attributes

    def _living(self, name: str) -> NDArray[np.float32]:
        """Attribute ``name`` of the living surfels of all submaps."""
        present = self.map.attribute(name, stable=False)
        others = [each.surfels[name][each.living] for each in self._submaps.detached]
        return np.concatenate([present, *others]) if others else present

    def corrected_trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Fused frames (N,) and their poses (N, 4, 4) in the present maps; see the base class."""
        return self._submaps.trajectory()

    def submaps(self) -> Submaps:
        """The submaps and the links between them."""
        return self._submaps.summary()

    @property
    def frames_counted(self) -> int:
        """Index of the next frame, as the trajectory and the submaps count."""
        return self._slam.last_frame() + 1

    @property
    def closes_loops(self) -> bool:
        """Whether the map is deformed when the camera returns to a place."""
        return self.config.loop_closure != "none"

    def mark_lost(self) -> None:
        """Relocalize the next frame: search near the last pose and at similar keyframes."""
        self._slam.mark_lost()

    def get_state(self) -> dict[str, Any]:
        """Everything needed to continue bit-exactly, as NumPy arrays."""
        color = {} if self._color_camera is None else self._color_camera.get_state()
        return self._slam.get_state() | color | {"submaps": self._submaps.get_state()}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        color = {} if self._color_camera is None else self._color_camera.state_like()
        return self._slam.state_like() | color | {"submaps": self._submaps.state_like()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state that ``get_state`` returned."""
        check_has(state, ("submaps",), type(self).__name__)
        self._slam.set_state(state)
        self._submaps.set_state(state["submaps"])
        if self._color_camera is not None:
            self._color_camera.set_state(state)
