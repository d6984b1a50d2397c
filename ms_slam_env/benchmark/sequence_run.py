"""A SLAM backend over a sequence: trajectory, map and metrics in a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, slam
from ms_slam_env.benchmark.frame_records import FRAMES, write_frames
from ms_slam_env.benchmark.point_cloud import write_ply
from ms_slam_env.evaluation.run_sequence import SequenceRun
from ms_slam_env.geometry import invert
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.sequences import Sequence, associate
from ms_slam_env.sequences.recording import Recording
from ms_slam_env.sequences.trajectory import (
    MAX_DIFFERENCE_S,
    TRAJECTORY_HEADER,
    trajectory_line,
    write_trajectory,
)
from ms_slam_env.slam.frame_selection import EveryFrameConfig, FrameSelectionConfig

Float64 = NDArray[np.float64]

TRAJECTORY, UNFINISHED, MAP, METRICS = (
    "trajectory.txt",
    "trajectory.incomplete.txt",
    "map.ply",
    "metrics.json",
)
CORRECTED = "trajectory.corrected.txt"
TRUTH = "groundtruth.txt"


def run_to_folder(
    sequence: Sequence,
    backend: str,
    params: dict[str, Any],
    out: Path,
    fed: Mapping[str, Any] | None = None,
    management: FrameSelectionConfig | None = None,
) -> dict[str, Any]:
    """Track every frame of ``sequence`` and write what came of it to ``out``.

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
    system = management.manage(slam.make(backend, sequence.intrinsics, **params))
    run = SequenceRun(system, sequence, meter=costs, progress=sequence.name)
    out.mkdir(parents=True, exist_ok=True)
    for old in (TRAJECTORY, CORRECTED, TRUTH, MAP, METRICS, FRAMES):
        (out / old).unlink(missing_ok=True)
    recording = sequence.frames if isinstance(sequence.frames, Recording) else None
    result: dict[str, Any] = {"complete": False}
    about = {
        "sequence": sequence.name,
        "layout": "rendered" if recording is None else recording.layout,
        "backend": backend,
        "params": params,
        **(fed or {}),
        "frame_management": asdict(management),
        "registration": _registration(recording),
        "image_size": f"{sequence.intrinsics.width}x{sequence.intrinsics.height}",
        **provenance(),
    }
    try:
        with (out / UNFINISHED).open("w", encoding="utf-8") as file:
            file.write(TRAJECTORY_HEADER + "\n")
            for step in run:
                pose = step.result.T_world_camera
                file.write(trajectory_line(step.frame.timestamp, pose) + "\n")
                file.flush()
        write_ply(out / MAP, system.surface_points(), system.map_attributes())
        corrected = run.corrected()
        if corrected is not None:
            write_trajectory(out / CORRECTED, run.timestamps, corrected)
            corrections = trajectory_errors(run, corrected, sequence)
            result.update(
                (f"{name}_corrected", corrections[name])
                for name in ("ate_m", "rpe_m")
                if name in corrections
            )
        truth = sequence.true_trajectory()
        if truth is not None:
            write_trajectory(out / TRUTH, *truth)
        os.replace(out / UNFINISHED, out / TRAJECTORY)
        result["complete"] = True
    except BaseException as error:
        result["error"] = str(error) or type(error).__name__
        raise
    finally:
        result.update(measure(run, sequence))
        write_frames(out / FRAMES, run.timestamps, run.tracking_ok.tolist(), run.costs)
        write_json(out / METRICS, {**result, **about})
    return result


def _registration(recording: Recording | None) -> str | None:
    """How colour was brought into the depth camera, in words; None where it was not."""
    if recording is None or recording.registration is None:
        return None
    return str(recording.registration)


def measure(run: SequenceRun, sequence: Sequence) -> dict[str, Any]:
    """Metrics of a run, finished or not; those against the truth only where there is one.

    ``frames``, ``lost_frames``, ``processed_frames``, ``path_m`` of the estimate; what
    `trajectory_errors` gives; the costs by the names of ``CostMeter.summary``.
    """
    if not len(run) or run.meter is None:
        return {"frames": 0}
    return {
        "frames": len(run),
        "lost_frames": run.lost_frames,
        "processed_frames": int(run.processed.sum()),
        "path_m": metrics.path_length(run.estimates),
        **run.meter.summary(),
        **trajectory_errors(run, run.estimates, sequence),
    }


def trajectory_errors(run: SequenceRun, poses: Float64, sequence: Sequence) -> dict[str, Any]:
    """Errors of poses (N, 4, 4) against the true ones; empty with fewer than two of these.

    ``compared`` poses; ``ate_m`` (RMSE after SE(3) alignment), ``ate_max_m``, ``ate_rad`` (RMSE of
    the orientation after it, None where the path is a line), ``ate_unaligned_m``, ``rpe_m``,
    ``rpe_rad``.
    """
    truth = sequence.true_trajectory()
    if truth is None:
        return {}
    own, true = associate(np.array(run.timestamps), truth[0], MAX_DIFFERENCE_S)
    if len(own) < 2:
        return {}
    P, Q = poses[own], truth[1][true]
    ate = metrics.ate_statistics(P, Q)
    return {
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
