"""A SLAM backend over a recorded sequence: trajectory, map and metrics in a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ms_slam_env import metrics, slam
from ms_slam_env.benchmark.frame_records import FRAMES, write_frames
from ms_slam_env.benchmark.point_cloud import write_ply
from ms_slam_env.geometry import invert
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.sequences import associate
from ms_slam_env.sequences.recording import Recording
from ms_slam_env.sequences.tum import TRAJECTORY_HEADER, trajectory_line, write_trajectory
from ms_slam_env.slam.base import TrackResult
from ms_slam_env.slam.frame_management import EveryFrameConfig, FrameManagementConfig

Float64 = NDArray[np.float64]

TRAJECTORY, UNFINISHED, MAP, METRICS = (
    "trajectory.txt",
    "trajectory.incomplete.txt",
    "map.ply",
    "metrics.json",
)
CORRECTED = "trajectory.corrected.txt"
TRUTH = "groundtruth.txt"
MAX_DIFFERENCE_S = 0.02


@dataclass
class Track:
    """What SLAM said, frame by frame."""

    costs: metrics.CostMeter
    times: list[float] = field(default_factory=list)
    poses: list[Float64] = field(default_factory=list)
    tracking_ok: list[bool] = field(default_factory=list)
    processed: list[bool] = field(default_factory=list)

    def append(self, timestamp: float, result: TrackResult) -> None:
        """Add a frame."""
        self.times.append(timestamp)
        self.poses.append(result.T_world_camera)
        self.tracking_ok.append(result.tracking_ok)
        self.processed.append(result.processed)


def run_sequence(
    recording: Recording,
    backend: str,
    params: dict[str, Any],
    out: Path,
    fed: Mapping[str, Any] | None = None,
    management: FrameManagementConfig | None = None,
) -> dict[str, Any]:
    """Track every frame of ``recording`` and write what came of it to ``out``.

    Those that ``management`` drops are not processed; their poses are predicted.
    SLAM starts at the true pose of the first frame where that is known, else at the identity.
    While it runs, the trajectory so far stands in ``trajectory.incomplete.txt``; at the end it is
    renamed to ``trajectory.txt``, beside ``map.ply`` and ``metrics.json``. Where the backend closes
    loops, ``trajectory.corrected.txt`` holds the poses as the finished map has them; where the true
    poses are known, ``groundtruth.txt`` holds those; what every frame cost stands in
    ``frames.csv``. A run that fails or is interrupted leaves the unfinished file and a
    ``metrics.json`` that says so, and says how the frames were ``fed`` to the backend.

    Returns:
        the content of ``metrics.json``.

    Raises:
        InputError: a bad option, or an image that cannot be read.
    """
    costs = metrics.CostMeter(str(params.get("device", "cpu")))
    management = management or EveryFrameConfig()
    system = management.manage(slam.make(backend, recording.intrinsics, **params))
    system.reset(_start(recording))
    out.mkdir(parents=True, exist_ok=True)
    for old in (TRAJECTORY, CORRECTED, TRUTH, MAP, METRICS, FRAMES):
        (out / old).unlink(missing_ok=True)
    track = Track(costs)
    result: dict[str, Any] = {"complete": False}
    about = {
        "sequence": recording.name,
        "layout": recording.layout,
        "backend": backend,
        "params": params,
        **(fed or {}),
        "frame_management": asdict(management),
        "registration": None if recording.registration is None else str(recording.registration),
        "image_size": f"{recording.intrinsics.width}x{recording.intrinsics.height}",
        **provenance(),
    }
    try:
        with (out / UNFINISHED).open("w", encoding="utf-8") as file:
            file.write(TRAJECTORY_HEADER + "\n")
            _track_all(recording, system, track, file)
        write_ply(out / MAP, system.surface_points(), system.map_attributes())
        corrected = _corrected(track, system)
        if corrected is not None:
            write_trajectory(out / CORRECTED, corrected.times, np.stack(corrected.poses))
            corrections = measure(corrected, recording)
            result.update(
                (f"{name}_corrected", corrections[name])
                for name in ("ate_m", "rpe_m")
                if name in corrections
            )
        if recording.truth is not None and recording.truth_times is not None:
            write_trajectory(out / TRUTH, recording.truth_times, recording.truth)
        os.replace(out / UNFINISHED, out / TRAJECTORY)
        result["complete"] = True
    except BaseException as error:
        result["error"] = str(error) or type(error).__name__
        raise
    finally:
        result.update(measure(track, recording))
        write_frames(out / FRAMES, track.times, track.tracking_ok, track.costs.frames)
        write_json(out / METRICS, {**result, **about})
    return result


def _track_all(recording: Recording, system: slam.SlamBackend, track: Track, file: TextIO) -> None:
    with tqdm(total=len(recording), desc=recording.name, unit="frame") as bar:
        for frame in recording:
            with track.costs.frame():
                result = system.track(frame)
            track.append(frame.timestamp, result)
            file.write(trajectory_line(frame.timestamp, result.T_world_camera) + "\n")
            file.flush()
            bar.set_postfix_str("tracking" if result.tracking_ok else "LOST", refresh=False)
            bar.update()


def _corrected(track: Track, system: slam.SlamBackend) -> Track | None:
    """The run with the poses that the finished map has; None if the backend corrects none."""
    frames, poses = system.corrected_trajectory()
    if not len(frames):
        return None
    final = list(track.poses)
    for frame, pose in zip(frames, poses, strict=True):
        final[frame] = pose
    return replace(track, poses=final)


def _start(recording: Recording) -> Float64 | None:
    """The true pose of the first frame, where one is near in time."""
    if recording.truth is None or recording.truth_times is None:
        return None
    nearest = int(np.abs(recording.truth_times - recording.timestamps[0]).argmin())
    if abs(recording.truth_times[nearest] - recording.timestamps[0]) > MAX_DIFFERENCE_S:
        return None
    return recording.truth[nearest]


def measure(track: Track, recording: Recording) -> dict[str, Any]:
    """Metrics of a run, finished or not; those against the truth only where there is one.

    ``frames``, ``lost_frames``, ``processed_frames``, ``path_m`` of the estimate;
    ``ate_m`` (RMSE after SE(3) alignment), ``ate_max_m``,
    ``ate_rad`` (RMSE of the orientation after it, None where the path is a line), ``rpe_m``,
    ``rpe_rad``; the costs by the names of ``CostMeter.summary``.
    """
    if not track.times:
        return {"frames": 0}
    poses = np.stack(track.poses)
    cost = track.costs.summary()
    result: dict[str, Any] = {
        "frames": len(poses),
        "lost_frames": int(len(poses) - sum(track.tracking_ok)),
        "processed_frames": sum(track.processed),
        "path_m": metrics.path_length(poses),
        **cost,
    }
    if recording.truth is None or recording.truth_times is None:
        return result
    times = np.array(track.times)
    estimate, truth = associate(times, recording.truth_times, MAX_DIFFERENCE_S)
    if len(estimate) < 2:
        return result
    P, Q = poses[estimate], recording.truth[truth]
    ate = metrics.ate_statistics(P, Q)
    return {
        **result,
        "compared": len(P),
        "ate_m": ate.rmse,
        "ate_max_m": ate.max,
        "ate_rad": _orientation_error(P, Q),
        "ate_unaligned_m": metrics.ate_rmse(Q[0] @ invert(P[0]) @ P, Q, align="none"),
        "rpe_m": metrics.rpe_rmse(P, Q),
        "rpe_rad": metrics.rpe_rmse(P, Q, kind="rotation"),
    }


def _orientation_error(P: Float64, Q: Float64) -> float | None:
    """RMS angle in radians between aligned and true poses; None if positions leave it open."""
    unique = metrics.find_alignment(P, Q).unique
    return metrics.ate_rmse(P, Q, kind="rotation") if unique else None
