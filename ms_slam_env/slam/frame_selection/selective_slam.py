"""A SLAM backend that sees only selected frames, and the interface of frame filters."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame, check_frame
from ms_slam_env.geometry import check_pose, invert, se3_exp, se3_log
from ms_slam_env.slam.shared.state import Saved, Stateful, check_has
from ms_slam_env.slam.shared.state_check import ArrayOf, Fields, OrNone, WholeNumber
from ms_slam_env.slam.shared.submap_frames import Submaps
from ms_slam_env.slam.slam_backend import BorrowedMap, SlamBackend, TrackResult


class FrameFilter(Stateful):
    """Decides, frame by frame, whether SLAM processes it.

    The first frame, frames while tracking is lost and those after the longest permitted gap are
    always processed; the filter is still asked about them.
    """

    @abstractmethod
    def reset(self) -> None:
        """Forget every frame."""

    @abstractmethod
    def admits(self, frame: RGBDFrame, dropped: int, forced: bool = False) -> bool:
        """Whether to process ``frame``.

        Args:
            frame: the sensor's frame.
            dropped: frames that were dropped since the last processed one.
            forced: whether the frame is processed whatever the answer; the filter records it.
        """

    def charge(self, seconds: float) -> None:
        """Record the last frame's processor time, including the filter's own."""


PREDICTIONS = ("last", "constant-velocity")
"""Kinds of pose prediction for dropped frames."""


class PosePrediction(Saved):
    """Extrapolates the last processed pose.

    Args:
        is_moving: move with the velocity between the last two processed frames, but no farther than
            the camera moved between them; otherwise stay at rest. A frame dropped as similar cannot
            be far away; without the limit a camera that stops would drift on.
    """

    saved = ("_pose", "_twist", "_frames")

    def __init__(self, is_moving: bool) -> None:
        self._is_moving = is_moving
        self.reset()

    def reset(self) -> None:
        """Forget every pose."""
        self._pose: Float64 = np.eye(4)
        self._twist: Float64 = np.zeros(6)  # last motion, over this many frames:
        self._frames = 1

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return super().state_like() | {"frames": WholeNumber(least=1)}

    def observe(self, T_world_camera: Float64, frames: int, continues: bool) -> None:
        """Record the pose of a processed frame, ``frames`` after the one before.

        ``continues`` says whether the motion between them is the camera's own; it is not at the
        start, across lost tracking or across a closed loop.
        """
        if self._is_moving and continues:
            self._twist = se3_log(invert(self._pose) @ T_world_camera)
        else:
            self._twist = np.zeros(6)
        self._pose = T_world_camera.copy()
        self._frames = frames

    def pose(self, frames: int) -> Float64:
        """T_world_camera (4, 4) ``frames`` after the last processed frame."""
        if not self._is_moving:
            return self._pose.copy()
        return self._pose @ se3_exp(min(1.0, frames / self._frames) * self._twist)

    def guess(self, frames: int) -> Float64 | None:
        """The same pose as an initial guess for tracking; None if no motion is known."""
        return self.pose(frames) if self._twist.any() else None


class SelectiveSlam(Saved, BorrowedMap):
    """A backend behind a filter: active frame management (Saeedi et al., ICRA 2017, section V-A).

    The backend does not see dropped frames. Their result has ``processed`` False and a predicted
    pose; its other fields repeat the last processed frame's. Every frame is processed until the
    backend has started and while its tracking is lost.

    If the caller has no guess, the frame after a gap is also tracked from the predicted pose,
    because the backend's own motion model spans the previous gap, which may be longer or shorter.

    Args:
        backend: any backend; nothing else may feed it frames.
        frame_filter: decides which frames to process.
        max_skip: most frames dropped in a row.
        pose: prediction for a dropped frame without a known or guessed pose, ``constant-velocity``
            or ``last``.
    """

    saved: ClassVar[tuple[str, ...]] = ("backend", "_filter", "_prediction", "_frames")
    also_saved = ("last", "processed", "dropped", "offsets")

    def __init__(
        self,
        backend: SlamBackend,
        frame_filter: FrameFilter,
        max_skip: int = 10,
        pose: str = "constant-velocity",
    ) -> None:
        self.backend = backend
        self.intrinsics = backend.intrinsics
        self._filter = frame_filter
        self._max_skip = max_skip
        self._prediction = PosePrediction(pose == "constant-velocity")
        self._forget()

    def _forget(self) -> None:
        """Return to the state before the first frame."""
        self._filter.reset()
        self._prediction.reset()
        self._frames = 0  # since reset
        self._last: TrackResult | None = None  # of the last processed frame
        self._processed: list[int] = []  # frames that the backend has counted
        self._offsets: dict[int, Float64] = {}  # of dropped frames from the last processed one

    def reset(self, T_world_camera: ArrayLike | None = None) -> None:
        """Forget everything; the next frame is taken at ``T_world_camera`` (identity if None)."""
        self.backend.reset(T_world_camera)
        self._forget()

    def track(self, frame: RGBDFrame, T_world_camera_guess: ArrayLike | None = None) -> TrackResult:
        """Estimate the pose of ``frame`` and fuse it, or drop it; see ``SlamBackend``."""
        if T_world_camera_guess is not None:
            check_pose(T_world_camera_guess, "T_world_camera_guess")

        def process() -> TrackResult:
            guess = T_world_camera_guess
            if guess is None and self._dropped:
                guess = self._prediction.guess(self._dropped + 1)
            return self.backend.track(frame, guess)

        return self._process_or_drop(frame, T_world_camera_guess, process)

    def fuse(self, frame: RGBDFrame, T_world_camera: ArrayLike) -> TrackResult:
        """Fuse ``frame`` into the map at a known pose (4, 4) without tracking, or drop it."""
        check_pose(T_world_camera, "T_world_camera")
        process = partial(self.backend.fuse, frame, T_world_camera)
        return self._process_or_drop(frame, T_world_camera, process)

    def _process_or_drop(
        self, frame: RGBDFrame, known_pose: ArrayLike | None, process: Callable[[], TrackResult]
    ) -> TrackResult:
        check_frame(frame, self.intrinsics)
        begin = time.process_time()
        result = self._note(process()) if self._is_worth(frame) else self._drop(known_pose)
        self._filter.charge(time.process_time() - begin)
        return result

    @property
    def _dropped(self) -> int:
        """Frames dropped since the last processed one."""
        return self._frames - 1 - self._processed[-1] if self._processed else 0

    def _is_worth(self, frame: RGBDFrame) -> bool:
        is_lost = self._last is None or not self._last.tracking_ok
        forced = is_lost or self._dropped >= self._max_skip
        admitted = self._filter.admits(frame, self._dropped, forced)
        return admitted or forced

    def _note(self, result: TrackResult) -> TrackResult:
        """Count a frame that the backend has processed."""
        before, dropped = self._last, self._dropped
        self._processed.append(self._frames)
        self._frames += 1
        self._last = replace(result, loop=None)
        jumped = result.relocalised or result.loop_closed or result.submaps_joined
        moved = False
        if before is not None and before.submap == result.submap:
            moved = before.tracking_ok and result.tracking_ok and not jumped
        self._prediction.observe(result.T_world_camera, dropped + 1, moved)
        if result.loop is None:
            return result
        reference = self._processed[result.loop.reference]
        return replace(result, loop=replace(result.loop, reference=reference))

    def _drop(self, known_pose: ArrayLike | None) -> TrackResult:
        """Make the result of a dropped frame."""
        assert self._last is not None  # the first frame is processed
        pose = self._prediction.pose(self._dropped + 1)
        if known_pose is not None:
            pose = np.array(known_pose, dtype=np.float64)
        self._offsets[self._frames] = invert(self._last.T_world_camera) @ pose
        self._frames += 1
        return replace(
            self._last,
            T_world_camera=pose,
            relocalised=False,
            covariance=None,
            drift=None,
            loop_closed=False,
            submaps_joined=False,
            processed=False,
        )

    @property
    def _mapper(self) -> SlamBackend:
        return self.backend

    def map_points(self) -> Float64:
        """Every point (M, 3) of the backend's map, metres."""
        return self.backend.map_points()

    def submaps(self) -> Submaps:
        """The backend's submaps; frame numbers count from ``reset`` and include dropped frames."""
        own = self.backend.submaps()
        counted = np.array(self._processed or [0], dtype=np.int32)
        joined = np.where(own.joined_at >= 0, counted[own.joined_at], -1).astype(np.int32)
        return replace(own, first_frames=counted[own.first_frames], joined_at=joined)

    @property
    def frames_counted(self) -> int:
        """Number of the next frame, counting dropped ones."""
        return self._frames

    @property
    def needs_color(self) -> bool:
        """Whether the backend needs colour."""
        return self.backend.needs_color

    @property
    def closes_loops(self) -> bool:
        """Whether the backend closes loops."""
        return self.backend.closes_loops

    def mark_lost(self) -> None:
        """Treat tracking as lost; the backend sees the next frame."""
        self._last = None
        self.backend.mark_lost()

    def save(self, path: str | Path) -> None:
        """Write the backend's map, without the filter's state."""
        self.backend.save(path)

    def load(self, path: str | Path, lost: bool = True) -> None:
        """Load the backend's map from a file; the filter restarts."""
        self.backend.load(path, lost)
        self._forget()
        self._frames = self.backend.frames_counted
        self._processed = list(range(self._frames))

    def corrected_trajectory(self) -> tuple[NDArray[np.int32], Float64]:
        """Frame numbers (N,), counted from ``reset`` with dropped frames, and poses (N, 4, 4).

        A dropped frame moves with the processed one before it, and is included if the backend
        corrects that one.
        """
        own, poses = self.backend.corrected_trajectory()
        corrected = {self._processed[k]: pose for k, pose in zip(own, poses, strict=True)}
        for frame, offset in self._offsets.items():
            anchor = self._anchor(frame)
            if anchor in corrected:
                corrected[frame] = corrected[anchor] @ offset
        frames = sorted(corrected)
        stack = [corrected[frame] for frame in frames]
        return np.array(frames, dtype=np.int32), np.stack(stack) if stack else np.zeros((0, 4, 4))

    def _anchor(self, frame: int) -> int:
        """The processed frame before a dropped one."""
        return self._processed[int(np.searchsorted(self._processed, frame)) - 1]

    def get_state(self) -> dict[str, Any]:
        """Return everything needed to continue bit-exactly, as NumPy arrays and plain values."""
        last = self._last
        return super().get_state() | {
            "last": None if last is None else _copied(vars(last)),
            "processed": np.array(self._processed, dtype=np.int64),
            "dropped": np.array(list(self._offsets), dtype=np.int64),
            "offsets": np.array(list(self._offsets.values())).reshape(-1, 4, 4),
        }

    def state_like(self) -> Any:
        """See ``Stateful``; "frames" are those that the backend has counted."""
        result = _copied(vars(TrackResult(np.eye(4), True)))
        result |= dict.fromkeys(("covariance", "drift"), OrNone(np.zeros((6, 6))))
        result |= {"moving": OrNone(ArrayOf(np.bool_, ("rows", "columns")))}
        like = {
            "last": OrNone(result),
            "processed": ArrayOf(np.int64, ("frames",), least=0),
            "dropped": ArrayOf(np.int64, ("dropped",), least=0),
            "offsets": ArrayOf(np.float64, ("dropped", 4, 4)),
        }
        return Fields(super().state_like() | like, _why_no_selection)

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state of the same backend behind the same filter."""
        check_has(state, self.also_saved, type(self).__name__)
        super().set_state(state)
        self._last = None if state["last"] is None else TrackResult(**_copied(state["last"]))
        self._processed = state["processed"].tolist()
        self._offsets = dict(zip(state["dropped"].tolist(), state["offsets"].copy(), strict=True))


def _why_no_selection(state: dict[str, Any]) -> str:
    """What is inconsistent between a state's processed frames and its frame count."""
    processed, frames = state["processed"], state["frames"]
    if (np.diff(processed) <= 0).any() or (processed >= frames).any():
        return f"has processed frames that are not among its {frames}, in order"
    if bool(frames) != bool(len(processed)) or (state["last"] is not None and not frames):
        return "has frames of which none was processed, or a last one of none"
    dropped = state["dropped"]
    is_after = len(processed) and (dropped > processed[0]).all()
    if len(dropped) and not (is_after and (dropped < frames).all()):
        return "has dropped frames that are not among its frames"
    return ""


def _copied(values: dict[str, Any]) -> dict[str, Any]:
    """Fields of a ``TrackResult`` except its loop, which is reported once."""
    copies = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in values.items()}
    return {k: v for k, v in copies.items() if k != "loop"}
