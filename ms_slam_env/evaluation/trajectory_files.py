"""Match the poses of two trajectory files in time, and check that they show the same recording."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.input_files import read_text
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.metrics.relative import (
    DELTA_UNITS,
    PAIRINGS,
    TOLERANCE,
)
from ms_slam_env.metrics.trajectory import ALIGNMENTS, check_first
from ms_slam_env.sequences import associate, read_trajectory

_GAP_INTERVALS = 3.0
_LEAST_SHARE = 0.5  # of the poses of the shorter trajectory that must correspond
_MOST_EXTENT = 3.0  # largest ratio of the extents of the two trajectories
_LEAST_SPREAD_M = 0.02  # below this the truth stands still, and nothing more can be checked
_MOST_SPREAD = 0.7  # above this, alignment explains less than half of the positions' variance
_MOST_TURN = np.pi / 6  # of the median pose; rad
_FITS = 0.2  # of that spread: an error below this, after a change of scale, is no accident
TURN_IS_OPEN = (
    "the path is too straight or short, for errors as large, to align orientations by positions: "
    "their ATE says little"
)
_FRAME_COLUMNS = ("timestamp", "tracking_ok")
_BESIDE = "frames.csv"  # written by ms-slam run into the folder of the estimate


@dataclass(frozen=True)
class TrajectoryOptions(Checked):
    """How two trajectories are compared.

    Attributes:
        align: ``se3``, ``sim3``, ``yaw``, ``origin`` or ``none``, see ``metrics.find_alignment``.
            With ``sim3``, relative errors use the scaled estimate, too.
        align_first: number of first corresponding poses to align; None for all.
        delta: distance between the two poses of a relative error.
        delta_unit: ``frames``, ``m`` along the true path, or ``s``.
        pairs: ``all`` or ``consecutive``, see ``metrics.pose_pairs``.
        tolerance: of a delta in metres or seconds, as a share of it.
        segments: number of equal pieces of the trajectory to give errors for.
        segment_lengths_m: lengths of sub-trajectories for drift; None for 10 % to 50 % of the
            path.
        max_difference_s: largest difference between corresponding timestamps.
        gap_s: an estimate without poses for longer than this was lost; None for three times the
            median interval.
        frames: ``frames.csv`` of ``ms-slam run``. Poses of untracked frames, which it also
            writes, are left out, and each leaves a gap. Without this option, a ``frames.csv``
            beside the estimate leaves no pose out of the errors, but its untracked frames are
            gaps, too, and it adds the error of the tracked frames.
    """

    align: str = chosen("se3", *ALIGNMENTS)
    align_first: int | None = bounded(None, 1, 1_000_000_000)
    delta: float = 1
    delta_unit: str = chosen("frames", *DELTA_UNITS)
    pairs: str = chosen("all", *PAIRINGS)
    tolerance: float = bounded(TOLERANCE, 0.0, 1.0)
    segments: int = bounded(1, 1, 1_000_000)
    segment_lengths_m: Sequence[float] | None = None
    max_difference_s: float = bounded(0.02, 0.0, 1e9)
    gap_s: float | None = bounded(None, 0.0, 1e9)
    frames: str | None = None

    def __post_init__(self) -> None:
        """Refuse invalid options."""
        super().__post_init__()
        check_first(self.align, self.align_first)
        if self.delta_unit == "frames" and float(self.delta).is_integer():
            object.__setattr__(self, "delta", int(self.delta))

    @property
    def relative(self) -> dict[str, Any]:
        """The options of a relative error."""
        return {
            "delta": self.delta,
            "unit": self.delta_unit,
            "pairs": self.pairs,
            "tolerance": self.tolerance,
        }


@dataclass(frozen=True)
class Matched:
    """The corresponding poses of two trajectories.

    Attributes:
        times: (N,) of the estimate, seconds.
        estimate: (N, 4, 4) T_world_camera, aligned with the truth.
        raw: (N, 4, 4) the same as read.
        truth: (N, 4, 4).
        true_path: (M, 3) all true positions from the first of these poses to the last.
        piece: (N,) number of the piece, between gaps, that the pose belongs to; a run of
            untracked frames is a piece of its own.
        gaps: (K, 2) last time before and first time after each gap; where it is known which
            frames were tracked, from the first frame or to the last if these were lost.
        alignment: the alignment found.
        unmatched: number of estimated poses without a true pose close enough in time.
        tracked: (N,) whether the frame was tracked; None if unknown.
        tracked_share: share of all estimated poses; None likewise.
        lost_before: whether frames before these poses were left out as untracked.
        lost_after: whether frames after these poses were left out as untracked.
        span_s: seconds from the first pose of the estimate to its last, tracked or not.
        truth_after_s: seconds for which the truth goes on after the last pose of the estimate.
        ends_early: whether that is longer than a gap.
        covered_share: share of the true trajectory's time in which the estimate has (tracked)
            poses: neither before its first, nor after its last, nor in a gap.
    """

    times: Float64
    estimate: Float64
    raw: Float64
    truth: Float64
    true_path: Float64
    piece: NDArray[np.int64]
    gaps: Float64
    alignment: metrics.Alignment
    unmatched: int
    tracked: NDArray[np.bool_] | None = None
    tracked_share: float | None = None
    lost_before: bool = False
    lost_after: bool = False
    span_s: float = 0.0
    truth_after_s: float = 0.0
    ends_early: bool = False
    covered_share: float = 1.0


def _is_named_truth(path: Path) -> bool:
    named = r"truth|(^|[^a-z])(gt|ref|reference)([^a-z]|$)"
    return re.search(named, Path(path).stem, re.IGNORECASE) is not None


def match_files(estimate: Path, truth: Path, options: TrajectoryOptions) -> Matched:
    """Read two TUM files, match their poses in time, and align them.

    Raises:
        InputError: a file that cannot be read, fewer than two poses in common, no alignment.
    """
    if _is_named_truth(estimate) and not _is_named_truth(truth):
        text = f"{estimate} is named like a truth, {truth} is not: the estimate comes first"
        warnings.warn(text, InputWarning, 2)
    times, poses = read_trajectory(estimate)
    tracked = (
        tracked_beside(estimate, times)
        if options.frames is None
        else tracked_at(Path(options.frames), times)
    )
    share_tracked = None if tracked is None else float(tracked.mean())
    shown, every = times, np.arange(len(times))
    kept = every if tracked is None else np.flatnonzero(tracked)
    own = every if options.frames is None else kept
    if options.frames is not None and len(own) < 2:
        raise InputError(f"{options.frames} leaves {len(own)} tracked poses; at least 2 are needed")
    times, poses = times[own], poses[own]
    tracked = None if tracked is None else tracked[own]
    true_times, true_poses = read_trajectory(truth)
    first, second = associate(times, true_times, options.max_difference_s)
    if len(first) < 2:
        raise InputError(
            f"{estimate} and {truth} have {len(first)} timestamps in common "
            f"(at most {options.max_difference_s} s apart); at least 2 are needed"
        )
    raw, true = poses[first], true_poses[second]
    alignment = metrics.find_alignment(raw, true, options.align, options.align_first)
    share = len(first) / min(len(times), len(true_times))
    found = complaints(raw, true, share, options.align == "sim3")
    for complaint in found:
        warnings.warn(f"{truth} may be of another recording: {complaint}", InputWarning, 2)
    by_positions = options.align in ("se3", "sim3") and alignment.unique
    if by_positions and not found and is_turn_open(alignment.poses(raw), true):
        warnings.warn(f"{truth}: {TURN_IS_OPEN}; --align origin needs no path", InputWarning, 2)
    if len(first) < _LEAST_SHARE * len(times):
        text = f"{estimate}: only {len(first)} of {len(times)} poses have a true one in {truth}"
        warnings.warn(text, InputWarning, 2)
    gap_s = options.gap_s
    if gap_s is None:
        gap_s = _GAP_INTERVALS * float(np.median(np.diff(times)))
    gaps = _gaps(shown, kept, gap_s)
    truth_after_s = max(0.0, float(true_times[-1] - shown[-1]))
    breaks = (np.diff(times) > gap_s) | (np.diff(own) > 1)
    if tracked is not None:
        breaks |= tracked[1:] != tracked[:-1]
    return Matched(
        times=times[first],
        estimate=alignment.poses(raw),
        raw=raw,
        truth=true,
        true_path=true_poses[second[0] : second[-1] + 1, :3, 3],
        piece=np.concatenate([[0], np.cumsum(breaks)])[first],
        gaps=gaps,
        alignment=alignment,
        unmatched=len(times) - len(first),
        tracked=None if tracked is None else tracked[first],
        tracked_share=share_tracked,
        lost_before=bool(own[0] > 0),
        lost_after=bool(own[-1] < len(shown) - 1),
        span_s=float(shown[-1] - shown[0]),
        truth_after_s=truth_after_s,
        ends_early=truth_after_s > gap_s,
        covered_share=_covered(shown, gaps, true_times),
    )


def matched_frames(
    times: Float64, poses: Float64, truth: Float64, tracked: NDArray[np.bool_]
) -> Matched:
    """Compare the poses of a run with the true ones of the same frames, after SE(3) alignment.

    Args:
        times: (N,) seconds.
        poses: (N, 4, 4) T_world_camera, held where a frame was lost.
        truth: (N, 4, 4).
        tracked: (N,) whether the frame was tracked.
    """
    alignment = metrics.find_alignment(poses, truth)
    gaps = _gaps(times, np.flatnonzero(tracked), np.inf)
    return Matched(
        times=times,
        estimate=alignment.poses(poses),
        raw=poses,
        truth=truth,
        true_path=truth[:, :3, 3],
        piece=np.concatenate([[0], np.cumsum(tracked[1:] != tracked[:-1])]),
        gaps=gaps,
        alignment=alignment,
        unmatched=0,
        tracked=tracked,
        tracked_share=float(tracked.mean()),
        span_s=float(times[-1] - times[0]),
        covered_share=_covered(times, gaps, times),
    )


def _gaps(times: Float64, kept: NDArray[np.int64], gap_s: float) -> Float64:
    """Gaps (K, 2) in seconds between the ``kept`` (M,) of the ``times`` (N,), and beyond them."""
    at = np.unique([0, *kept, len(times) - 1])
    has_pose = np.isin(at, kept)
    is_gap = np.diff(times[at]) > gap_s
    is_gap |= (np.diff(at) > 1) | ~has_pose[1:] | ~has_pose[:-1]
    jumps = np.flatnonzero(is_gap)
    return np.stack([times[at][jumps], times[at][jumps + 1]], axis=1)


def _covered(times: Float64, gaps: Float64, true_times: Float64) -> float:
    """Share of the true time between the first and last of ``times`` (N,) without the gaps."""
    first, last = true_times[0], true_times[-1]
    spans = np.clip(np.concatenate([[[times[0], times[-1]]], gaps]), first, last)
    lengths = np.diff(spans, axis=1)[:, 0]
    return float((lengths[0] - lengths[1:].sum()) / (last - first)) if last > first else 1.0


def complaints(
    estimate: Float64, truth: Float64, share: float = 1.0, with_scale: bool = False
) -> list[str]:
    """Signs that two trajectories are not of the same recording.

    Args:
        estimate: (N, 4, 4).
        truth: (N, 4, 4) at the same times.
        share: share of the shorter trajectory's poses that correspond.
        with_scale: whether the scale of the estimate is free.
    """
    alignment = metrics.find_alignment(estimate, truth, "sim3" if with_scale else "se3")
    aligned = alignment.poses(estimate)
    found = []
    if share < _LEAST_SHARE:
        found.append(f"only {share:.0%} of the poses of the shorter trajectory correspond in time")
    centred = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    spread_m = float(np.sqrt((centred**2).sum(axis=1).mean()))
    if spread_m < _LEAST_SPREAD_M:
        return found
    extents = [float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0))) for poses in (aligned, truth)]
    small, large = sorted(extents)
    if large > _MOST_EXTENT * small:
        found.append(
            f"the estimate extends over {extents[0]:.3g} m, the truth over {extents[1]:.3g} m"
            + _fitting_scale(estimate, truth, spread_m)
        )
    error_m = metrics.ate_rmse(aligned, truth, align="none")
    if error_m > _MOST_SPREAD * spread_m:
        found.append(
            f"the aligned estimate is {error_m:.3g} m off where the true positions themselves lie "
            f"{spread_m:.3g} m around their mean"
        )
    elif alignment.unique and not is_turn_open(aligned, truth):
        angles = metrics.absolute_errors(aligned, truth, "none", "rotation")
        off_deg = float(np.degrees(np.median(angles)))
        if off_deg > np.degrees(_MOST_TURN):
            found.append(
                f"where positions fit, orientations are {off_deg:.3g} deg off (median), as of "
                "another body or of quaternions that begin with qw"
            )
    return found


def is_turn_open(aligned: Float64, truth: Float64) -> bool:
    """Whether the errors of positions may have turned their alignment by 30 degrees or more.

    Poses are (N, 4, 4). An error of e may turn a path about its best line by about e over the
    distance d of the path from it (RMS both).
    """
    centred = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    beside_m = np.linalg.norm(np.linalg.svd(centred, compute_uv=False)[1:]) / len(truth) ** 0.5
    return bool(metrics.ate_rmse(aligned, truth, align="none") >= _MOST_TURN * beside_m)


def _fitting_scale(estimate: Float64, truth: Float64, spread_m: float) -> str:
    """Name the scale that makes the estimate fit; nothing if none does."""
    if np.ptp(estimate[:, :3, 3], axis=0).max() < 1e-6:
        return ""  # it stands still
    scaled = metrics.find_alignment(estimate, truth, "sim3")
    error_m = metrics.ate_rmse(scaled.poses(estimate), truth, align="none")
    if error_m > _FITS * spread_m:
        return ""
    return (
        f"; times {scaled.scale:.3g} it fits, as with a wrong depth scale or with one camera, for "
        "which --align sim3 is meant"
    )


def tracked_beside(estimate: Path, times: Float64) -> NDArray[np.bool_] | None:
    """Whether the frame of each pose (N,) was tracked, from a ``frames.csv`` beside the file.

    None if there is none; one for other frames is ignored with a warning.
    """
    path = estimate.parent / _BESIDE
    try:
        return tracked_at(path, times) if path.is_file() else None
    except InputError as error:
        warnings.warn(f"left aside: {error}", InputWarning, 2)
    return None


def tracked_at(path: Path, times: Float64) -> NDArray[np.bool_]:
    """Whether the frames at ``times`` (N,) were tracked, from ``frames.csv`` of ``ms-slam run``.

    Raises:
        InputError: a file that cannot be read, is malformed (the message names file and line) or
            is for other frames.
    """
    reader = csv.DictReader(read_text(path, "frames").splitlines())
    if not set(_FRAME_COLUMNS) <= set(reader.fieldnames or ()):
        raise InputError(f"{path}, line 1: expected columns {', '.join(_FRAME_COLUMNS)}")
    known: dict[int, bool] = {}
    for row in reader:
        try:
            microseconds = round(1e6 * float(row["timestamp"]))  # precision of both files
            known[microseconds] = {"0": False, "1": True}[row["tracking_ok"]]
        except (TypeError, ValueError, OverflowError, KeyError):
            raise InputError(
                f"{path}, line {reader.line_num}: expected a timestamp and tracking_ok 0 or 1"
            ) from None
    found = [known.get(round(1e6 * t)) for t in times]
    if None in found:
        t = times[found.index(None)]
        raise InputError(f"{path} belongs to other frames: it has none at {t:.6f} s")
    return np.array(found, dtype=bool)
