"""Run SLAM over a sequence; write trajectory, map, cost of every frame and metrics to a folder."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.interrupts import recorded
from ms_slam_env._runtime.output_files import growing_file, write_bytes
from ms_slam_env._runtime.result_folders import alone_in, result_folder
from ms_slam_env.errors import InputWarning
from ms_slam_env.evaluation.run_files import (
    COSTS,
    MESH,
    check_open3d,
    frame_costs,
    write_frames,
    write_mesh,
    write_ply,
)
from ms_slam_env.evaluation.run_sequence import SequenceRun
from ms_slam_env.evaluation.submap_errors import (
    paths_by_submap,
    submap_errors,
    submap_measures,
    submap_numbers,
    write_submaps,
)
from ms_slam_env.evaluation.tracking_diagnosis import (
    REFUSED,
    RefusedFrame,
    alignment_chart,
    lost_reasons,
    lost_table,
)
from ms_slam_env.evaluation.trajectory_charts import error_panel, marked_panel, path_panel
from ms_slam_env.evaluation.trajectory_files import TURN_IS_OPEN, complaints, is_turn_open
from ms_slam_env.geometry import invert
from ms_slam_env.report.charts import Chart, Panel
from ms_slam_env.report.results import write_results
from ms_slam_env.report.tables import Table, make_table
from ms_slam_env.sequences import Sequence, associate
from ms_slam_env.sequences.recording import Recording
from ms_slam_env.sequences.trajectory import (
    MAX_DIFFERENCE_S,
    TRAJECTORY_HEADER,
    trajectory_line,
    write_trajectory,
)
from ms_slam_env.slam.frame_selection import EveryFrameConfig, FrameSelectionConfig
from ms_slam_env.slam.slam_backend import check_saves

TRAJECTORY, UNFINISHED = "trajectory.txt", "trajectory.incomplete.txt"
CORRECTED, TRUTH = "trajectory.corrected.txt", "groundtruth.txt"
MAP, FRAMES, METRICS = "map.ply", "frames.csv", "metrics.json"
SUBMAPS = "submaps.csv"
WRITTEN = (METRICS, TRAJECTORY, CORRECTED, TRUTH, MAP, MESH, FRAMES, SUBMAPS, REFUSED)
"""Files that a finished run may leave in its folder."""

_ABOUT = "A SLAM backend over a sequence: its path, its error, what each frame cost."
_TABLES = {
    "Frames and trajectory": (
        *(
            "frames",
            "processed_frames",
            "lost_frames",
            "uncertain_frames",
            "poses",
            "unmatched_poses",
            "path_m",
            "ate_m",
            "ate_tracked_m",
            "tracked_share",
        ),
        *("ate_max_m", "ate_rad"),
        *("ate_unaligned_m", "rpe_m", "rpe_rad", "final_ate_m", "final_rpe_m"),
    ),
    "Submaps": ("submaps", "joined_submaps", "unjoined_share", "joined_ate_m", "submap_ate_m"),
    "Cost": (
        *("cpu_ms_median", "cpu_ms_p95", "cpu_ms_max", "ext_ms", "ext_ms_p95", "ext_ms_max"),
        *("mem_mb", "mem_peak_mb", "ene_j", "ene_frame_j", "ene_source"),
        *("ene_model_j", "ene_model_frame_j", "energy_source"),
    ),
}


def run_to_folder(
    sequence: Sequence,
    backend: str,
    params: dict[str, Any],
    out: Path,
    fed: Mapping[str, Any] | None = None,
    selection: FrameSelectionConfig | None = None,
    map_in: Path | None = None,
    map_out: Path | None = None,
    mesh: bool = False,
    core_watts: float = metrics.CORE_WATTS,
) -> dict[str, Any]:
    """Track every frame of ``sequence`` and write the results to ``out``.

    Frames dropped by ``selection`` are not processed; their poses are predicted. SLAM starts at the
    true pose of the first frame if known, otherwise at the identity; or, with ``map_in``, at an
    unknown place in the map of that file, which it extends. At the end the map is saved to
    ``map_out``, from which a later run can continue, and with ``mesh`` as a mesh to ``mesh.ply``.
    ``core_watts`` is the power of a core in watts for estimating energy that cannot be measured.

    During the run, ``trajectory.incomplete.txt`` holds the trajectory so far. At the end it becomes
    ``trajectory.txt``. Further files are ``map.ply``, ``frames.csv`` with the cost of every frame
    and, last, ``metrics.json``, which also records how the frames were ``fed`` to the backend. If
    the backend closes loops, ``trajectory.corrected.txt`` holds the poses in the finished map. If
    true poses are known, ``groundtruth.txt`` holds them. If there are several submaps,
    ``submaps.csv`` assigns each frame to one. A run that fails or is interrupted leaves the
    unfinished trajectory, and ``frames.csv`` and ``metrics.json`` for the frames so far, marked as
    incomplete.

    Returns:
        the metrics in ``metrics.json``, and ``lost_reasons``, lines that say why frames were lost.

    Raises:
        InputError: a bad option, a map that cannot be extended, an image that cannot be read, or
            another process working in ``out``.
        OSError: a file that cannot be written.
    """
    if mesh:
        check_open3d()
    meter = metrics.CostMeter(str(params.get("device", "cpu")), core_watts=core_watts)
    selection = selection or EveryFrameConfig()
    made = slam.make(backend, sequence.intrinsics, **params)
    system = selection.manage(made)
    if map_out is not None:
        check_saves(made)
    if map_in is not None:
        system.load(map_in)
    run = SequenceRun(system, sequence, meter=meter, progress=sequence.name, reset=map_in is None)
    content = _about(sequence, backend, params, fed or {}, selection)
    content["map_in"] = None if map_in is None else str(map_in)
    refused = RefusedFrame(has_map=map_in is not None)
    with alone_in(out):
        return _run(run, sequence, out, content, refused, map_out, mesh)


def _run(
    run: SequenceRun,
    sequence: Sequence,
    out: Path,
    content: dict[str, Any],
    refused: RefusedFrame,
    map_out: Path | None,
    mesh: bool,
) -> dict[str, Any]:
    """Track and write, while no other process uses ``out``."""
    for old in WRITTEN:
        (out / old).unlink(missing_ok=True)
    try:
        with growing_file(out / UNFINISHED) as add:
            add(TRAJECTORY_HEADER)
            for step in run:
                add(trajectory_line(step.frame.timestamp, step.result.T_world_camera))
                refused.look(run, step)
                if map_out is not None and len(run) == 1:  # not after an hour of work
                    check_saves(run.backend)
        if map_out is not None:
            run.backend.save(map_out)
        result = _write(run, sequence, out, {"complete": True, **content}, refused, mesh)
    except BaseException as error:
        stopped = isinstance(error, KeyboardInterrupt)
        content["error"] = recorded(error)
        with suppress(OSError):  # a full disk: the poses written so far must do
            unfinished = {"complete": False, "interrupted": stopped, **content}
            _write(run, sequence, out, unfinished, refused, mesh=False)
            if stopped:
                error.args = (f"{len(run)} of {len(sequence)} frames are kept in {out}",)
        raise
    (out / UNFINISHED).unlink()
    _warn_of_misfit(run, sequence)
    return result


def _warn_of_misfit(run: SequenceRun, sequence: Sequence) -> None:
    """Warn where the poses of tracked frames in one map look as if the truth were not theirs."""
    if len(run.backend.submaps()) > 1:
        return
    times, P, Q = _pairs(run, run.estimates, sequence)
    ok = run.tracking_ok[np.isin(run.timestamps, times)]
    if ok.sum() < 2:
        return
    found = [
        f"the tracked poses do not fit the true ones: {one}" for one in complaints(P[ok], Q[ok])
    ]
    alignment = metrics.find_alignment(P, Q)
    if not found and alignment.unique and is_turn_open(alignment.poses(P), Q):
        found = [f"{TURN_IS_OPEN} (ate_rad); rpe_rad needs no alignment"]
    for text in found:
        warnings.warn(f"{sequence.name}: {text}", InputWarning, stacklevel=2)


def _write(
    run: SequenceRun,
    sequence: Sequence,
    out: Path,
    content: Mapping[str, Any],
    refused: RefusedFrame,
    mesh: bool,
) -> dict[str, Any]:
    """Write the results of a run, finished or not; return its metrics."""
    result: dict[str, Any] = {}
    with result_folder(out, METRICS) as folder:
        if content["complete"]:
            write_bytes(folder / TRAJECTORY, (out / UNFINISHED).read_bytes())
            result |= _write_finished(run, sequence, folder)
            if mesh:
                write_mesh(folder / MESH, run.backend)
        result |= measure(run, sequence)
        reasons = lost_reasons(run)
        why = {"lost_reasons": [str(reason) for reason in reasons]}
        refused.save(folder / REFUSED)
        write_frames(folder / FRAMES, run)
        write_results(
            folder / METRICS,
            kind="run",
            title=f"{content['backend']} over {sequence.name}",
            about=_ABOUT,
            tables=[*_tables(result), *([lost_table(reasons)] if reasons else [])],
            charts=_charts(run, sequence),
            content={**content, **why},
            metrics=result,
        )
    return result | why


def _write_finished(run: SequenceRun, sequence: Sequence, folder: Path) -> dict[str, Any]:
    """Write map and further trajectories; return errors after loop closure, and by submap."""
    write_ply(folder / MAP, run.backend.surface_points(), run.backend.map_attributes())
    truth, corrected = sequence.true_trajectory(), run.corrected()
    if truth is not None:
        write_trajectory(folder / TRUTH, *truth)
    final: dict[str, Any] = {}
    if corrected is not None:
        write_trajectory(folder / CORRECTED, run.timestamps, corrected)
        errors = trajectory_errors(run, corrected, sequence)
        final = {f"final_{key}": errors[key] for key in ("ate_m", "rpe_m") if key in errors}
    if len(run.backend.submaps()) > 1:
        write_submaps(folder / SUBMAPS, run)
        final |= _submap_errors(run, corrected, sequence)
    return final


def _about(
    sequence: Sequence,
    backend: str,
    params: dict[str, Any],
    fed: Mapping[str, Any],
    selection: FrameSelectionConfig,
) -> dict[str, Any]:
    """Describe what was run, for ``metrics.json``."""
    recording = sequence.frames if isinstance(sequence.frames, Recording) else None
    registration = None if recording is None else recording.registration
    return {
        "sequence": sequence.name,
        "layout": "rendered" if recording is None else recording.layout,
        "backend": backend,
        "params": params,
        **fed,
        "frame_management": asdict(selection),
        "registration": None if registration is None else str(registration),
        "image_size": f"{sequence.intrinsics.width}x{sequence.intrinsics.height}",
    }


# -- Metrics -----------------------------------------------------------------------------------


def measure(run: SequenceRun, sequence: Sequence) -> dict[str, Any]:
    """Metrics of a run, finished or not; errors only if there is ground truth.

    ``frames``, ``lost_frames``, ``uncertain_frames``, ``processed_frames``; ``path_m`` of the
    truth if it is complete, otherwise of the estimate; the results of `trajectory_errors`; and the
    costs of ``CostMeter.summary``.
    """
    if not len(run) or run.meter is None:
        return {"frames": 0}
    is_known = bool(np.isfinite(run.true_poses).all())
    return {
        "frames": len(run),
        "lost_frames": run.lost_frames,
        "uncertain_frames": run.uncertain_frames,
        "processed_frames": int(run.processed.sum()),
        "path_m": metrics.path_length(run.true_poses if is_known else run.estimates),
        **submap_measures(run),
        **run.meter.summary(),
        **trajectory_errors(run, run.estimates, sequence),
        **_tracked_errors(run, sequence),
    }


def _tracked_errors(run: SequenceRun, sequence: Sequence) -> dict[str, Any]:
    """``tracked_share`` of all frames, and ``ate_tracked_m`` if the truth is known."""
    times, P, Q = _pairs(run, run.estimates, sequence)
    ok = run.tracking_ok[np.isin(run.timestamps, times)]
    known = metrics.tracked_errors(P, Q, ok) if len(P) > 1 else {}
    return {**known, "tracked_share": 1.0 - run.lost}


def trajectory_errors(run: SequenceRun, poses: Float64, sequence: Sequence) -> dict[str, Any]:
    """Errors of poses (N, 4, 4) against the true ones; empty without true poses.

    ``poses`` counts those with a true pose, ``unmatched_poses`` those without. With at least two
    true poses: ``ate_m`` (RMSE after SE(3) alignment), ``ate_max_m``, ``ate_rad`` (RMSE of the
    orientation after it, None if the path is a line), ``ate_unaligned_m``, ``rpe_m``, ``rpe_rad``.
    """
    if sequence.true_trajectory() is None:
        return {}
    _, P, Q = _pairs(run, poses, sequence)
    counts = {"poses": len(P), "unmatched_poses": len(poses) - len(P)}
    if len(P) < 2:
        return counts
    ate = metrics.ate_statistics(P, Q)
    return {
        **counts,
        "ate_m": ate.rmse,
        "ate_max_m": ate.max,
        "ate_rad": _orientation_error(P, Q),
        "ate_unaligned_m": metrics.ate_rmse(Q[0] @ invert(P[0]) @ P, Q, align="none"),
        "rpe_m": metrics.rpe_rmse(P, Q),
        "rpe_rad": metrics.rpe_rmse(P, Q, kind="rotation"),
    }


def _pairs(run: SequenceRun, poses: Float64, sequence: Sequence) -> tuple[Float64, ...]:
    """Times (M,), poses (M, 4, 4) and the true ones (M, 4, 4) of frames that have a true one."""
    truth = sequence.true_trajectory()
    times = np.array(run.timestamps)
    if truth is None:
        return times[:0], poses[:0], poses[:0]
    own, true = associate(times, truth[0], MAX_DIFFERENCE_S)
    return times[own], poses[own], truth[1][true]


def _submap_errors(
    run: SequenceRun, corrected: Float64 | None, sequence: Sequence
) -> dict[str, Any]:
    """`submap_errors` of the poses in the finished map."""
    times, P, Q = _pairs(run, run.estimates if corrected is None else corrected, sequence)
    known = np.isin(run.timestamps, times)
    return dict(submap_errors(P, Q, submap_numbers(run)[known]))


def _orientation_error(P: Float64, Q: Float64) -> float | None:
    """RMS angle in radians between aligned and true poses; None if alignment is not unique."""
    unique = metrics.find_alignment(P, Q).unique
    return metrics.ate_rmse(P, Q, kind="rotation") if unique else None


# -- Tables and charts -------------------------------------------------------------------------


def _tables(result: Mapping[str, Any]) -> list[Table]:
    tables = []
    for title, keys in _TABLES.items():
        known = [key for key in keys if result.get(key) is not None]
        if known and (title != "Submaps" or result["submaps"] > 1):
            tables.append(make_table(known, [{key: result[key] for key in known}], title))
    return tables


def _charts(run: SequenceRun, sequence: Sequence) -> list[Chart]:
    """Charts of the path, the error over time, and the cost of every frame."""
    if len(run) < 2:
        return []
    times, P, Q = _pairs(run, run.estimates, sequence)
    corrected = run.corrected()
    paths = {"truth": Q[:, :3, 3]} if len(Q) else {}
    paths["estimate"] = _aligned(run, run.estimates, sequence)[:, :3, 3]
    if corrected is not None:
        paths["estimate, loops closed"] = _aligned(run, corrected, sequence)[:, :3, 3]
    how = "After SE(3) alignment with the truth." if len(P) > 1 else "As SLAM has it."
    caption = f"The two directions in which it extends most. {how}"
    found = [Chart("path", "Path", caption, [path_panel(paths)])]
    if len(run.backend.submaps()) > 1:
        final = run.estimates if corrected is None else corrected
        pieces = {name: path for name, path in paths.items() if name == "truth"}
        pieces |= paths_by_submap(_aligned(run, final, sequence), submap_numbers(run))
        caption = "As the finished map has the frames; submaps that were joined are one. " + how
        found.append(Chart("submaps", "Path by submap", caption, [path_panel(pieces)]))
    if len(P) > 1:
        aligned = metrics.find_alignment(P, Q).poses(P)
        distance = np.linalg.norm(aligned[:, :3, 3] - Q[:, :3, 3], axis=1)
        caption = "Distance from the true position after SE(3) alignment."
        panel = error_panel("position_error_m", times - run.timestamps[0], {"estimate": distance})
        found.append(Chart("error", "Error over time", caption, [panel]))
    found.append(alignment_chart(run))
    caption = "The frames for which SLAM had no pose are marked."
    return [*found, Chart("cost", "Cost of every frame", caption, _cost_panels(run))]


def _aligned(run: SequenceRun, poses: Float64, sequence: Sequence) -> Float64:
    """Poses (N, 4, 4) of all frames, aligned with the truth as for their errors."""
    _, P, Q = _pairs(run, poses, sequence)
    return metrics.find_alignment(P, Q).poses(poses) if len(P) > 1 else poses


def _cost_panels(run: SequenceRun) -> list[Panel]:
    costs, lost = frame_costs(run), np.flatnonzero(~run.tracking_ok)
    known = [key for key in COSTS if np.isfinite(costs[key]).any()]
    return [marked_panel(key, costs[key], lost) for key in known]
