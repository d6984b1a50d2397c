"""Whether colour is registered with depth, and what to do where it is not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera.registration import Registration
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.shared.state_check import ArrayOf, ListOf
from ms_slam_env.slam.slam_backend import Float32, Float64, TrackResult
from ms_slam_env.slam.surfel.color_registration import depth_edges, estimate_registration
from ms_slam_env.slam.surfel.slam import BatchedSurfelSlam

UInt8 = NDArray[np.uint8]

ENOUGH_EDGES = 6000  # points on depth steps, or
MOST_FRAMES = 60  # frames after which the offset of the cameras is estimated


class ColorCamera(Saved):
    """The colour of one camera's frames. This is the variant "given": it is taken as it comes."""

    def reset(self, T_world_camera: ArrayLike | None) -> None:
        """Begin anew at a pose (4, 4)."""

    def registered(self, slam: BatchedSurfelSlam, color: UInt8, depth: Float32) -> UInt8:
        """Colour (1, H, W, 3) as the depth camera would see it."""
        return color

    def track(
        self,
        slam: BatchedSurfelSlam,
        color: UInt8,
        depth: Float32,
        guess: ArrayLike | None,
        time_s: float,
    ) -> TrackResult:
        """Let a frame be tracked."""
        return slam.track(color, depth, [guess], [time_s])[0]


class EstimatedColorCamera(ColorCamera):
    """The variant "estimated": the offset is looked for in the first frames, and then undone.

    Once it is found those frames, of which at most ``MOST_FRAMES`` are kept until then, are tracked
    once more with their colour registered, as a new map. Should one of them have been lost or fused
    at a known pose, the map stays as it is, and later frames alone are registered.
    """

    saved = (
        *("_start", "_colors", "_depths", "_guesses", "_times", "_edges", "_is_whole", "_offset"),
    )

    def __init__(self) -> None:
        self.reset(None)

    def reset(self, T_world_camera: ArrayLike | None) -> None:
        """See the base class."""
        self._start: Float64 = np.eye(4) if T_world_camera is None else np.array(T_world_camera)
        self._offset: Float64 = np.full(2, np.nan)  # focal ratio and baseline; NaN: not known yet
        self._is_whole = True  # nothing but the frames kept is in the map
        self._forget()

    def state_like(self) -> Any:
        """See ``Stateful``."""
        like = {
            "colors": ListOf(ArrayOf(np.uint8, ("height", "width", 3)), "first frames"),
            "depths": ListOf(ArrayOf(np.float32, ("height", "width"), least=0), "first frames"),
            "guesses": ListOf(ArrayOf(np.float64, (4, 4), may_be_nan=True), "first frames"),
            "times": ListOf(0.0, "first frames"),
        }
        return super().state_like() | like

    def _forget(self) -> None:
        self._edges = 0
        self._colors: list[UInt8] = []
        self._depths: list[Float32] = []
        self._guesses: list[Float64] = []
        self._times: list[float] = []

    def registered(self, slam: BatchedSurfelSlam, color: UInt8, depth: Float32) -> UInt8:
        """See the base class."""
        focal_ratio, baseline_m = self._offset.tolist()
        if not self._is_known or (focal_ratio, baseline_m) == (1.0, 0.0):
            return color
        camera = Registration(focal_ratio, baseline_m)
        return camera.register(color[0], depth[0], slam.intrinsics)[None]

    @property
    def _is_known(self) -> bool:
        return bool(np.isfinite(self._offset[0]))

    def track(
        self,
        slam: BatchedSurfelSlam,
        color: UInt8,
        depth: Float32,
        guess: ArrayLike | None,
        time_s: float,
    ) -> TrackResult:
        """See the base class."""
        result = super().track(slam, color, depth, guess, time_s)
        if self._is_known:
            return result
        if self._depths and self._depths[0].shape != depth[0].shape:
            self._forget()  # ``reconfigure``
        self._colors.append(color[0].copy())
        self._depths.append(depth[0].copy())
        self._guesses.append(np.full((4, 4), np.nan) if guess is None else np.array(guess))
        self._times.append(time_s)
        self._edges += len(depth_edges(depth[0], slam.intrinsics))
        self._is_whole &= result.tracking_ok and slam.last_frame() + 1 == len(self._times)
        if self._edges < ENOUGH_EDGES and len(self._times) < MOST_FRAMES:
            return result
        edges = [depth_edges(one, slam.intrinsics) for one in self._depths]
        found = estimate_registration(self._colors, edges, slam.intrinsics)
        camera = found or Registration(1.0, 0.0)
        self._offset = np.array([camera.focal_ratio, camera.baseline_m])
        if found is not None and self._is_whole:
            result = self._track_again(slam)
        self._forget()
        return result

    def _track_again(self, slam: BatchedSurfelSlam) -> TrackResult:
        """Begin anew with the frames kept."""
        slam.reset(self._start)
        kept: Any = zip(self._colors, self._depths, self._guesses, self._times, strict=True)
        for color, depth, guess, time_s in kept:
            registered = self.registered(slam, color[None], depth[None])
            known = guess if np.isfinite(guess).all() else None
            result = super().track(slam, registered, depth[None], known, time_s)
        return result


def make_color_camera(variant: str) -> ColorCamera:
    """The variant ``SurfelConfig.color_registration``."""
    return EstimatedColorCamera() if variant == "estimated" else ColorCamera()
