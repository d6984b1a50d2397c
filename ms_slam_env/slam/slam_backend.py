"""The interface of every SLAM backend."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float32, Float64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import as_numbers
from ms_slam_env.slam.shared.state import Stateful
from ms_slam_env.slam.shared.state_check import check_like
from ms_slam_env.slam.shared.state_file import check_packable, read_state, write_state
from ms_slam_env.slam.shared.submap_frames import Submaps, one_submap

LARGEST_CUTOFF_M = 12.0
"""Largest depth cutoff of any backend: the range of the sensor model (``RangeNoise``)."""


@dataclass(frozen=True)
class Loop:
    """A closed loop: the camera's pose relative to a place that it has returned to.

    Attributes:
        reference: number of an old frame of that place, counted as in
            ``SlamBackend.frames_counted``.
        T_reference_camera: (4, 4) pose of the camera in the reference frame's camera frame.
        bent: whether the map was deformed; False where it nearly fits already.
    """

    reference: int
    T_reference_camera: Float64
    bent: bool = True


@dataclass(frozen=True)
class TrackResult:
    """SLAM's result for one frame.

    Attributes:
        T_world_camera: (4, 4) estimated pose; the last good one while tracking is lost.
        tracking_ok: whether the pose is known: the frame was aligned with the map.
        uncertain: whether the pose is doubtful: it is the best estimate available, its covariance
            is larger, and nothing was fused into the map.
        relocalised: whether this frame ended a period of lost tracking.
        inlier_fraction: share of the frame's valid pixels that the alignment explains.
        residual_m: RMS point-to-plane residual of the inliers, metres.
        overlap: share of the frame's readings that land on the view it was aligned with.
        reason: why tracking failed, in words; empty if it succeeded.
        refusal: the figure behind ``reason`` and what was demanded, as in "cost 1.61, at most
            1.42"; empty if nothing was refused, or not for a figure.
        loop_closed: whether this frame closed a loop: the map was deformed, and the pose jumped by
            the corrected drift.
        loop: the loop that was found, even if it nearly fitted and the map was not deformed; None
            if there was none.
        degenerate_directions: how many of the pose's six degrees of freedom the view does not
            constrain, as in front of a blank wall; along them the pose is only predicted.
        covariance: (6, 6) covariance of the pose relative to the map, the error of one alignment;
            it excludes the map's own drift and does not grow along the way. It is that of the twist
            xi = (rho, phi) in metres and radians, in the camera's frame, with the true pose
            T_world_camera exp(xi). None if no pose was estimated or the backend does not compute
            it. The motion between two frames in view of the same surface has about the sum of
            their covariances, the earlier carried along (``metrics.motion_twists``).
        drift: (6, 6) covariance, of the same twist, of where the map about the camera lies in the
            world of the first pose. ``covariance + drift`` is that of T_world_camera itself. It
            does not shrink where the camera comes back or a loop is closed. None where
            ``covariance`` is None or the backend does not compute it.
        submap: number of the frame's submap, that is of the oldest submap it is joined to. The pose
            in a submap not joined to the first is only as good as the guess it started from, and
            ``covariance`` includes that error.
        submaps_joined: whether this frame joined two submaps: the newer was moved onto the older.
            If the newer is the current one, the pose jumped by the error of its start.
        moving: (h, w) bool, every n-th row and column of the mask of moving objects, which are
            neither tracked nor mapped; None if the backend does not detect them.
        processed: False if frame selection dropped the frame: SLAM has not seen it, the pose is
            predicted and ``tracking_ok`` keeps its last value.
    """

    T_world_camera: Float64
    tracking_ok: bool
    relocalised: bool = False
    inlier_fraction: float = 1.0
    residual_m: float = 0.0
    reason: str = ""
    degenerate_directions: int = 0
    covariance: Float64 | None = None
    uncertain: bool = False
    overlap: float = 1.0

    @property
    def fused(self) -> bool:
        """Whether the frame became part of the map."""
        return self.tracking_ok and self.processed and not self.uncertain

    @property
    def degenerate(self) -> bool:
        """Whether the view left a direction of the pose unconstrained."""
        return self.degenerate_directions > 0

    loop_closed: bool = False
    loop: Loop | None = None
    processed: bool = True
    submap: int = 0
    submaps_joined: bool = False
    moving: NDArray[np.bool_] | None = None
    refusal: str = ""
    drift: Float64 | None = None


@dataclass(frozen=True)
class Views:
    """Images predicted from the map.

    Attributes:
        intensity: (N, h, w) float32 in [0, 255]; 0 where the map is empty.
        depth: (N, h, w) float32 metres; 0 where the map is empty.
        normals: (N, h, w, 3) float32 unit vectors in the camera frame, facing the camera; 0 where
            the map is empty.
        intrinsics: intrinsics of the predicted images.
    """

    intensity: Float32
    depth: Float32
    normals: Float32
    intrinsics: Intrinsics


class SlamBackend(Stateful):
    """Estimates the camera's pose from RGB-D frames and builds a map that it can render.

    Attributes:
        intrinsics: intrinsics of every frame.
        config: dataclass of the parameters; None for a backend without any.
        options: options that a user's backend was made with by its name; a saved map names them.
    """

    intrinsics: Intrinsics
    config: Any = None
    options: Mapping[str, Any] | None = None

    @abstractmethod
    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""

    @abstractmethod
    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and fuse it into the map.

        Args:
            frame: the sensor's frame.
            T_world_camera_guess: (4, 4) where the camera may be, for example from an arm's forward
                kinematics. It is one more initial pose for the alignment, not a constraint. The
                first frame after ``reset`` is taken at the pose given there.

        Raises:
            InputError: the frame's size differs from the intrinsics, or the guess is not a pose.
        """

    @abstractmethod
    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` into the map at a known pose (4, 4), without tracking.

        ``track`` may continue from there.

        Raises:
            InputError: the frame's size differs from the intrinsics, or the pose is not one.
        """

    @abstractmethod
    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render the map from ``poses`` (N, 4, 4) T_world_camera at ``scale`` times the size.

        If there are several submaps: the current one and all that are joined to it.
        """

    def project(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render each view from the map itself; see ``predict``.

        The same as ``predict`` for a backend that does so anyway.
        """
        return self.predict(poses, scale)

    @abstractmethod
    def surface_points(self) -> Float64:
        """Points (M, 3) of the estimated surface in the world frame, metres.

        Includes all submaps; unjoined ones are placed by the best guess.
        """

    @abstractmethod
    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``, in the same order."""

    def map_points(self) -> Float64:
        """All points (M, 3) of the map, metres, including those not yet confirmed by later frames.

        The same as ``surface_points`` for a backend without confirmation.
        """
        return self.surface_points()

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Attributes of ``surface_points`` by name, in the same order.

        ``color`` (M, 3) uint8 RGB; if the backend has them, ``normal`` (M, 3), ``radius`` (M,)
        metres and ``confidence`` (M,); ``submap`` (M,) int32 if there are several submaps.
        """
        return {"color": self.surface_colors()}

    def corrected_trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Frame numbers (N,), counted from ``reset``, and their poses (N, 4, 4) in the current map.

        Closed loops and joined submaps have moved them since ``track`` returned them. Empty if
        there were neither.
        """
        return np.zeros(0, dtype=np.int32), np.zeros((0, 4, 4))

    def submaps(self) -> Submaps:
        """The submaps and how they are joined now; one if the backend never starts others."""
        return one_submap()

    @property
    def needs_color(self) -> bool:
        """Whether tracking is impossible from depth alone."""
        return False

    @property
    def frames_counted(self) -> int:
        """Number of the next frame, as counted in corrected poses, submaps and closed loops.

        0 for a backend that has none of them.
        """
        return 0

    @property
    def closes_loops(self) -> bool:
        """Whether it reports returning to a known place (``TrackResult.loop``)."""
        return False

    def mark_lost(self) -> None:
        """Treat tracking as lost: search the whole map for the next frame.

        Need not be overridden by a backend that always searches this way.
        """

    def save(self, path: str | Path) -> None:
        """Write map and pose to a file atomically; `load` reads it.

        Raises:
            InputError: the state or the configuration contains something that a file cannot hold.
            OSError: the file cannot be written.
        """
        write_state(Path(path), _origin(self), _state_of(self))

    def load(self, path: str | Path, lost: bool = True) -> None:
        """Load a map that `save` of the same kind of backend wrote, and continue mapping in it.

        Args:
            path: path of the file.
            lost: whether the camera has moved since, so that the next frame is relocalised in the
                map; False continues bit-exactly from the saved camera pose.

        Raises:
            InputError: the file is missing or damaged, comes from another version, backend or
                camera, or from a configuration that stores other things. The backend is unchanged.
        """
        about, state = read_state(Path(path))
        _check_origin(self, about, path)
        own = self.get_state()
        try:
            self.reset()
            check_like(state, self.state_like(), "map")
            self.set_state(state)
        except Exception as error:  # a part may fail on a state that only looks valid
            self.set_state(own)
            reason = str(error) if isinstance(error, InputError) else repr(error)
            raise InputError(f"{path} does not fit this backend: {reason}") from None
        if lost:
            self.mark_lost()


def check_saves(backend: SlamBackend) -> None:
    """Refuse a backend whose map cannot be saved, before any work is done.

    Raises:
        InputError: the message names the part of the state or configuration that does not fit.
    """
    check_packable(_origin(backend), _state_of(backend))


def _origin(backend: SlamBackend) -> dict[str, Any]:
    """What a file says about the backend that wrote it."""
    config = backend.config
    if config is not None and (not is_dataclass(config) or isinstance(config, type)):
        raise InputError(
            f"{type(backend).__name__}.config = {config!r} must be a dataclass or None"
        )
    origin = {
        "backend": type(backend).__name__,
        "module": type(backend).__module__,
        "intrinsics": _camera(backend),
        "config": None if config is None else asdict(config),
    }
    if backend.options is not None:
        origin["options"] = {name: repr(value) for name, value in backend.options.items()}
    return origin


def _state_of(backend: SlamBackend) -> dict[str, Any]:
    cannot = f"a map of {type(backend).__name__} cannot be saved: its get_state"
    try:
        state = backend.get_state()
    except NotImplementedError:
        raise InputError(f"{cannot} is not implemented") from None
    if not isinstance(state, Mapping):
        raise InputError(f"{cannot} returned a {type(state).__name__}, not a mapping")
    return state


def _check_origin(backend: SlamBackend, about: Mapping[str, Any], path: str | Path) -> None:
    """Refuse the map of another backend or camera."""
    name = type(backend).__name__
    if about.get("backend") != name:
        raise InputError(f"{path} holds a map of {about.get('backend')}, not of {name}")
    own, saved = _camera(backend), about.get("intrinsics")
    if not isinstance(saved, Mapping) or set(saved) != set(own):
        raise InputError(f"{path} does not say which camera made its map")
    sizes = [f"{camera['width']}x{camera['height']}" for camera in (saved, own)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"{path} holds a map made from images of {sizes[0]}, not {sizes[1]}; "
            f"continue at --image-size {sizes[0]}"
        )
    others = [key for key in own if saved[key] != own[key]]
    if others:
        said = "; ".join(f"{key} {_short(saved[key])}, not {_short(own[key])}" for key in others)
        raise InputError(f"{path} holds a map of another camera: {said}")


def _short(number: Any) -> str:
    return f"{number:.9g}" if isinstance(number, float) else repr(number)


def _camera(backend: SlamBackend) -> dict[str, Any]:
    """Intrinsics of the camera without the lens distortion."""
    numbers = asdict(backend.intrinsics)
    del numbers["distortion"]
    return numbers


def check_views(poses: ArrayLike, scale: float) -> Float64:
    """Return ``poses`` as an array (N, 4, 4); refuse other shapes and a scale outside (0, 1]."""
    stack = as_numbers(poses, "poses")
    if stack.ndim != 3 or stack.shape[1:] != (4, 4):
        raise InputError(f"poses must have shape (N, 4, 4), got {stack.shape}")
    if not np.isfinite(stack).all():
        raise InputError("poses hold a value that is not finite")
    if not isinstance(scale, Real) or not 0 < scale <= 1:
        raise InputError(f"scale = {scale!r} is outside (0, 1]")
    return stack


class BorrowedMap(SlamBackend):
    """A backend whose surface is that of another backend."""

    @property
    @abstractmethod
    def _mapper(self) -> SlamBackend:
        """The backend with the surface, up to date."""

    def predict(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render the surface from ``poses`` (N, 4, 4) T_world_camera; see ``SlamBackend``."""
        return self._mapper.predict(poses, scale)

    def project(self, poses: ArrayLike, scale: float = 1.0) -> Views:
        """Render each view from the surface itself; see ``SlamBackend``."""
        return self._mapper.project(poses, scale)

    def surface_points(self) -> Float64:
        """Points (M, 3) of the surface in the world frame, metres."""
        return self._mapper.surface_points()

    def surface_colors(self) -> NDArray[np.uint8]:
        """Colours (M, 3) RGB of ``surface_points``."""
        return self._mapper.surface_colors()

    def map_attributes(self) -> dict[str, NDArray[Any]]:
        """Attributes of ``surface_points``."""
        return self._mapper.map_attributes()
