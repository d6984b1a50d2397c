"""Run SLAM over a sequence, frame by frame, and record results and costs.

The whole sequence at once, with what a comparison needs::

    sequence = open_sequence("living_room:2000", with_truth=True)
    meter = CostMeter()                                  # before SLAM, to count all its memory
    run = run_sequence(slam.make("surfel", sequence.intrinsics), sequence, meter=meter)
    ate_rmse(run.estimates, run.true_poses), run.lost, run.cpu_ms, run.backend.surface_points()

Frame by frame, to inspect intermediate states, stop early, or feed SLAM in another way::

    run = SequenceRun(backend, sequence)
    for step in run:                                     # step.index, step.frame, step.result
        if step.result.tracking_ok: break                # run keeps what was recorded so far

After a kidnapping, continuing with the current pose and map::

    run_sequence(backend, frames, reset=False)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env import slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.progress import Bar
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.metrics.cost import CostMeter
from ms_slam_env.metrics.cost.meter import FrameCost
from ms_slam_env.sequences.sequence import Sequence
from ms_slam_env.slam.slam_backend import SlamBackend, TrackResult

Track = Callable[[RGBDFrame], TrackResult]


@dataclass(frozen=True)
class Step:
    """One frame that SLAM has processed.

    Attributes:
        index: number of the frame in the run.
        frame: the frame given to SLAM.
        result: SLAM's result.
    """

    index: int
    frame: RGBDFrame
    result: TrackResult


class SequenceRun:
    """A run of SLAM over a sequence, and its record; iterate over it to process frames.

    The record holds the frames tracked so far, also after a ``break`` or an error; iterating again
    continues with the next frame. Frames are not kept.

    Args:
        backend: SLAM backend, wrapped in its frame selection or adaptation if it has one.
        frames: a sequence, whose true poses are recorded too, or N frames without true poses.
        start: (4, 4) T_world_camera of the first frame; by default its true pose if known,
            otherwise the identity.
        reset: False continues from the current pose and map, without ``start``.
        meter: measures each frame; create it before the backend. Without one, only time is
            measured.
        track: called instead of ``backend.track``.
        progress: label of a progress bar that shows whether SLAM is tracking; no bar if empty.

    Attributes:
        backend: the SLAM backend.
        results: N results.
        timestamps: N times in seconds.
        costs: N costs of tracking one frame; memory and energy are NaN without a meter.
    """

    def __init__(
        self,
        backend: SlamBackend,
        frames: Sequence | Iterable[RGBDFrame],
        *,
        start: ArrayLike | None = None,
        reset: bool = True,
        meter: CostMeter | None = None,
        track: Track | None = None,
        progress: str = "",
    ) -> None:
        self.backend = backend
        self.results: list[TrackResult] = []
        self.timestamps: list[float] = []
        self.meter = meter
        self._track = track or backend.track
        self._stopwatch = _Stopwatch()
        self._true_poses: Float64 | None = None
        self._total: int | None = len(frames) if isinstance(frames, Sized) else None
        self._progress = progress
        if isinstance(frames, Sequence):
            if backend.needs_color and not frames.has_color:
                raise InputError(
                    f"sequence {frames.name} has no colour, without which {type(backend).__name__} "
                    "tracks nothing; the backend surfel tracks depth alone"
                )
            self._true_poses = frames.poses
            start = frames.start if start is None else start
            frames = frames.frames
        self._frames = iter(frames)
        if reset:
            backend.reset(start)
        self._counted = backend.frames_counted  # of earlier sessions

    def __iter__(self) -> Iterator[Step]:
        """Track frame after frame."""
        clock = self.meter or self._stopwatch
        with Bar(
            desc=self._progress,
            total=self._total,
            initial=len(self.results),
            unit="frame",
            disable=not self._progress,
        ) as bar:
            for frame in self._frames:
                with clock.frame():
                    result = self._track(frame)
                self.results.append(result)
                self.timestamps.append(frame.timestamp)
                yield Step(len(self.results) - 1, frame, result)
                bar.set_postfix_str("tracking" if result.tracking_ok else "LOST", refresh=False)
                bar.update()

    def __len__(self) -> int:
        """Number of frames tracked so far."""
        return len(self.results)

    @property
    def costs(self) -> list[FrameCost]:
        """Cost of each frame."""
        return (self.meter or self._stopwatch).frames

    @property
    def estimates(self) -> Float64:
        """(N, 4, 4) estimated T_world_camera, each as returned with its frame."""
        return np.array([r.T_world_camera for r in self.results]).reshape(-1, 4, 4)

    @property
    def true_poses(self) -> Float64:
        """(N, 4, 4) true T_world_camera; NaN if unknown."""
        if self._true_poses is None:
            return np.full((len(self), 4, 4), np.nan)
        return self._true_poses[: len(self)]

    @property
    def tracking_ok(self) -> NDArray[np.bool_]:
        """(N,) whether SLAM was tracking."""
        return np.array([result.tracking_ok for result in self.results], dtype=bool)

    @property
    def anchored(self) -> NDArray[np.bool_]:
        """(N,) whether SLAM was tracking in the first submap or one already joined to it."""
        return self.tracking_ok & np.array([result.submap == 0 for result in self.results])

    @property
    def processed(self) -> NDArray[np.bool_]:
        """(N,) whether SLAM processed the frame; False if frame selection dropped it."""
        return np.array([result.processed for result in self.results], dtype=bool)

    @property
    def lost_frames(self) -> int:
        """Number of frames without tracking."""
        return int(len(self) - self.tracking_ok.sum())

    @property
    def uncertain_frames(self) -> int:
        """Number of frames that were tracked, but whose pose SLAM doubts."""
        return sum(result.uncertain for result in self.results)

    @property
    def lost(self) -> float:
        """Share of the frames without tracking."""
        return 1.0 - float(np.mean(self.tracking_ok))

    @property
    def cpu_ms(self) -> Float64:
        """(N,) milliseconds of processor time, of all threads, for tracking each frame."""
        return 1e3 * np.array([cost.cpu_s for cost in self.costs])

    @property
    def wall_ms(self) -> Float64:
        """(N,) milliseconds by the clock for tracking each frame."""
        return 1e3 * np.array([cost.ext_s for cost in self.costs])

    def corrected(self) -> Float64 | None:
        """(N, 4, 4) T_world_camera in the current map; None if the backend corrects no poses."""
        frames, poses = self.backend.corrected_trajectory()
        own = np.asarray(frames) >= self._counted
        if not own.any():
            return None
        final = self.estimates
        final[np.asarray(frames)[own] - self._counted] = poses[own]
        return final


def run_sequence(
    backend: SlamBackend,
    frames: Sequence | Iterable[RGBDFrame],
    *,
    start: ArrayLike | None = None,
    reset: bool = True,
    meter: CostMeter | None = None,
    track: Track | None = None,
    progress: str = "",
    on_step: Callable[[Step], None] = lambda step: None,
) -> SequenceRun:
    """Track every frame; arguments are those of `SequenceRun`.

    ``on_step`` is called after each frame.
    """
    run = SequenceRun(
        backend, frames, start=start, reset=reset, meter=meter, track=track, progress=progress
    )
    for step in run:
        on_step(step)
    return run


def run_backend(backend: str, sequence: Sequence, **how: Any) -> SequenceRun:
    """``run_sequence`` for a backend by name, with parameters as in ``surfel,submaps=off``."""
    name, params = parse_named(backend, "backend")
    return run_sequence(slam.make(name, sequence.intrinsics, **params), sequence, **how)


def lost_throughout(processed: int, lost: int) -> str:
    """A message if no frame was tracked after the one that started the map, otherwise empty.

    Args:
        processed: number of frames that SLAM processed.
        lost: how many of them were not tracked.
    """
    return f"lost in {lost} of {processed} frames" if lost >= max(1, processed - 1) else ""


class _Stopwatch:
    """Measures only time, without the memory and energy that a `CostMeter` reads."""

    def __init__(self) -> None:
        self.frames: list[FrameCost] = []

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Measure the enclosed work as one frame."""
        clock, processor = time.perf_counter(), time.process_time()
        yield
        cpu_s, ext_s = time.process_time() - processor, time.perf_counter() - clock
        self.frames.append(FrameCost(ext_s, cpu_s, math.nan, {}))
