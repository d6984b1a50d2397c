"""Two trajectory files compared: every measure of the poses that correspond in time."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.errors import InputError, InputWarning
from ms_slam_env.input_files import read_text
from ms_slam_env.metrics.relative import (
    DELTA_UNITS,
    PAIRINGS,
    TOLERANCE,
    printed_ate,
    printed_relative_errors,
)
from ms_slam_env.metrics.trajectory import ALIGNMENTS, check_first
from ms_slam_env.sequences import associate, read_trajectory

Float64 = NDArray[np.float64]

_GAP_INTERVALS = 3.0
_LEAST_SHARE = 0.5  # of the poses of the shorter trajectory
_MOST_EXTENT = 3.0  # times as far as the other
_LEAST_SPREAD_M = 0.02  # of a truth that stands still nothing more can be said
_MOST_SPREAD = 0.7  # an alignment explains less than half of the variance of the positions
_FRAME_COLUMNS = ("timestamp", "tracking_ok")
_BESIDE = "frames.csv"  # of ms-slam run, in the folder of the estimate
_ALIGNED = {
    **{"se3": "ate", "sim3": "ate_sim3", "yaw": "ate_yaw"},
    **{"origin": "ate_origin", "none": "ate_unaligned"},
}
"""Metric of the absolute error by alignment with all poses."""


@dataclass(frozen=True)
class TrajectoryOptions(Checked):
    """How two trajectories are compared.

    Attributes:
        align: ``se3``, ``sim3``, ``yaw``, ``origin`` or ``none``, see ``metrics.find_alignment``.
            With ``sim3`` relative errors are those of the estimate after scaling, too.
        align_first: least squares over so many of the first poses that correspond; None for all.
        delta: how far apart the poses of a relative error are.
        delta_unit: ``frames``, ``m`` along the true path, or ``s``.
        pairs: ``all`` or ``consecutive``, see ``metrics.pose_pairs``.
        tolerance: of a delta in metres or seconds, as a share of it.
        segments: equal pieces of the trajectory that errors are also given for.
        segment_lengths_m: of sub-trajectories for drift; None for a tenth to a half of the path.
        max_difference_s: largest difference between timestamps that correspond.
        gap_s: an estimate without poses for longer was lost in between; None for three times the
            median interval.
        frames: ``frames.csv`` of ``ms-slam run``: the poses of frames that were not tracked, which
            it writes too, are left out, and there is a gap wherever one was. Without it, one that
            lies beside the estimate leaves none out, but adds the error of tracked frames alone.
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
        """Refuse what cannot be."""
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
    """The poses of two trajectories that correspond.

    Attributes:
        times: (N,) of the estimate, seconds.
        estimate: (N, 4, 4) T_world_camera, aligned with the truth.
        raw: (N, 4, 4) the same as read.
        truth: (N, 4, 4).
        true_path: (M, 3) all true positions from the first of these poses to the last.
        piece: (N,) number of the piece, between gaps, that the pose belongs to.
        gaps: (K, 2) last time before and first after each gap.
        alignment: that was found.
        unmatched: poses of the estimate without a true one near enough in time.
        tracked: (N,) whether the frame was tracked; None where nothing says it.
        tracked_share: of all poses of the estimate; None likewise.
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


def match_files(estimate: Path, truth: Path, options: TrajectoryOptions) -> Matched:
    """Read two TUM files, find the poses that correspond, and align them.

    Raises:
        InputError: a file that cannot be read, fewer than two poses in common, no alignment.
    """
    times, poses = read_trajectory(estimate)
    tracked = (
        tracked_beside(estimate, times)
        if options.frames is None
        else tracked_at(Path(options.frames), times)
    )
    share_tracked = None if tracked is None else float(tracked.mean())
    was_lost = np.zeros(len(times), dtype=bool)
    if options.frames is not None and tracked is not None:
        kept = np.flatnonzero(tracked)
        was_lost = np.diff(kept, prepend=kept[0] - 1) > 1
        times, poses, tracked = times[kept], poses[kept], tracked[kept]
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
    best = metrics.find_alignment(raw, true, "sim3" if options.align == "sim3" else "se3")
    for complaint in complaints(best.poses(raw), true, share):
        warnings.warn(f"{truth} may be of another recording: {complaint}", InputWarning, 2)
    gap_s = options.gap_s
    if gap_s is None:
        gap_s = _GAP_INTERVALS * float(np.median(np.diff(times)))
    jumps = np.flatnonzero((np.diff(times) > gap_s) | was_lost[1:])
    return Matched(
        times=times[first],
        estimate=alignment.poses(raw),
        raw=raw,
        truth=true,
        true_path=true_poses[second[0] : second[-1] + 1, :3, 3],
        piece=np.searchsorted(jumps, first),
        gaps=np.stack([times[jumps], times[jumps + 1]], axis=1),
        alignment=alignment,
        unmatched=len(times) - len(first),
        tracked=None if tracked is None else tracked[first],
        tracked_share=share_tracked,
    )


def complaints(aligned: Float64, truth: Float64, share: float) -> list[str]:
    """What speaks against two trajectories being of one recording.

    Args:
        aligned: (N, 4, 4) estimate after the best alignment.
        truth: (N, 4, 4) at the same times.
        share: of the poses of the shorter trajectory, those that correspond.
    """
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
        )
    error_m = metrics.ate_rmse(aligned, truth, align="none")
    if error_m > _MOST_SPREAD * spread_m:
        found.append(
            f"the aligned estimate is {error_m:.3g} m off where the true positions themselves lie "
            f"{spread_m:.3g} m around their mean"
        )
    return found


def tracked_beside(estimate: Path, times: Float64) -> NDArray[np.bool_] | None:
    """Whether the frame of each pose (N,) was tracked, from a ``frames.csv`` beside the file.

    None where there is none; one that is of other frames is left aside with a warning.
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
        InputError: a file that cannot be read, of another form (the message names file and line)
            or of other frames; fewer than two that were tracked.
    """
    reader = csv.DictReader(read_text(path, "frames").splitlines())
    if not set(_FRAME_COLUMNS) <= set(reader.fieldnames or ()):
        raise InputError(f"{path}, line 1: expected columns {', '.join(_FRAME_COLUMNS)}")
    known: dict[int, bool] = {}
    for row in reader:
        try:
            microseconds = round(1e6 * float(row["timestamp"]))  # both are written to these
            known[microseconds] = {"0": False, "1": True}[row["tracking_ok"]]
        except (TypeError, ValueError, OverflowError, KeyError):
            raise InputError(
                f"{path}, line {reader.line_num}: expected a timestamp and tracking_ok 0 or 1"
            ) from None
    found = [known.get(round(1e6 * t)) for t in times]
    if None in found:
        t = times[found.index(None)]
        raise InputError(f"{path} is of other frames: it has none at {t:.6f} s")
    if sum(map(bool, found)) < 2:
        raise InputError(
            f"{path} leaves {sum(map(bool, found))} tracked poses; at least 2 are needed"
        )
    return np.array(found, dtype=bool)


def evaluate_files(
    estimate: Path, truth: Path, options: TrajectoryOptions | None = None
) -> dict[str, Any]:
    """Compare TUM file ``estimate`` with TUM file ``truth``, both T_world_camera.

    Returns:
        the metrics of `measure_matched`.

    Raises:
        InputError: as `match_files`; no two poses ``delta`` apart; more segments than poses.
    """
    options = options or TrajectoryOptions()
    return measure_matched(match_files(estimate, truth, options), options)


def measure_matched(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """The measures of poses that correspond, by keys of the registry.

    Returns:
        ``poses`` and ``unmatched_poses`` of the estimate; ``ate_m`` (RMSE),
        ``ate_mean_m``, ``ate_median_m``, ``ate_std_m``, ``ate_min_m``, ``ate_max_m``, and the same
        of ``ate_rad`` (None where the path is a line), ``rpe_m`` and ``rpe_rad``; with another
        alignment than SE(3) by all poses the key of `absolute_key` in the place of ``ate_m``;
        ``ate_printed_m`` and ``rpe_printed_m`` of USME's equations to the letter;
        ``tracked_share`` and, after SE(3), ``ate_tracked_m`` where it is known what was tracked;
        ``scale`` of the alignment, ``path_m``, ``duration_s``, ``pieces`` (the same statistics by
        piece), ``drift_by_length`` (of sub-trajectories), robustness (USME equations 9 and 10 over
        gaps in time) and initialisation (12 and 13).

    Raises:
        InputError: no two poses ``delta`` apart; more segments than poses.
    """
    count = len(matched.times)
    return {
        "poses": count,
        "unmatched_poses": matched.unmatched,
        "tracked_share": matched.tracked_share,
        "ate_tracked_m": _tracked_error(matched, options),
        "scale": matched.alignment.scale,
        "path_m": metrics.path_length(matched.truth),
        "estimate_path_m": metrics.path_length(matched.raw),
        "duration_s": float(matched.times[-1] - matched.times[0]),
        **_absolute_statistics(matched, slice(None), options),
        **_relative(matched, slice(None), options),
        **_as_printed(matched, options),
        "pieces": [
            {
                "start_s": float(matched.times[first] - matched.times[0]),
                "end_s": float(matched.times[end - 1] - matched.times[0]),
                "poses": int(end - first),
                **_absolute_statistics(matched, slice(first, end), options),
                **_relative_or_none(matched, slice(first, end), options),
            }
            for first, end in metrics.equal_pieces(count, options.segments)
        ],
        "drift_by_length": [
            {
                "length_m": drift.length_m,
                "sub_trajectories": drift.segments,
                **_named("drift_translation", drift.translation),
                **_named("drift_rotation_deg_m", drift.rotation_rad_m, np.degrees),
            }
            for drift in metrics.drifts(matched.estimate, matched.truth, options.segment_lengths_m)
        ],
        **_robustness(matched, options),
        **_initialisation(matched, options),
    }


def absolute(matched: Matched) -> tuple[Float64, Float64 | None]:
    """Errors (N,) of the aligned poses: metres, and radians unless the path leaves them open."""
    ate_m = metrics.absolute_errors(matched.estimate, matched.truth, "none")
    if not matched.alignment.unique:
        return ate_m, None
    return ate_m, metrics.absolute_errors(matched.estimate, matched.truth, "none", "rotation")


def statistic_keys(key: str) -> tuple[str, ...]:
    """Keys of the statistics of an error in the order of `ErrorStatistics`.

    ``ate_m`` itself is the root mean square, ``ate_mean_m`` the mean, and so on.
    """
    name, unit = re.fullmatch(r"(.*?)((?:_m|_rad|_deg_m)?)", key).groups()  # type: ignore[union-attr]
    others = (field.name for field in fields(metrics.ErrorStatistics) if field.name != "rmse")
    return (key, *(f"{name}_{statistic}{unit}" for statistic in others))


def _named(
    key: str, statistics: metrics.ErrorStatistics, convert: Callable[[float], float] = float
) -> dict[str, float]:
    """Statistics by key."""
    values = asdict(statistics).values()
    return {of: float(convert(v)) for of, v in zip(statistic_keys(key), values, strict=True)}


def absolute_key(options: TrajectoryOptions, unit: str) -> str:
    """Key of the absolute error, ``unit`` m or rad; one key means one alignment.

    ``ate_m``, ``ate_sim3_m``, ``ate_yaw_m``, ``ate_origin_m`` or ``ate_unaligned_m``;
    ``ate_first_m`` after an alignment by the first poses, as the options say.
    """
    name = _ALIGNED[options.align] if options.align_first is None else "ate_first"
    return f"{name}_{unit}"


def _tracked_error(matched: Matched, options: TrajectoryOptions) -> float | None:
    """ATE in metres of the tracked frames, aligned by themselves; None where it is not known."""
    ok = matched.tracked
    if ok is None or ok.sum() < 2 or absolute_key(options, "m") != "ate_m":
        return None
    return metrics.ate_rmse(matched.raw[ok], matched.truth[ok])


def _absolute_statistics(
    matched: Matched, part: slice, options: TrajectoryOptions
) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for unit, errors in zip(("m", "rad"), absolute(matched), strict=True):
        key = absolute_key(options, unit)
        found |= {key: None} if errors is None else _named(key, metrics.statistics_of(errors[part]))
    return found


def _relative(matched: Matched, part: slice, options: TrajectoryOptions) -> dict[str, Any]:
    P, Q, times = matched.estimate[part], matched.truth[part], matched.times[part]
    found: dict[str, Any] = {}
    for key, kind in (("rpe_m", "translation"), ("rpe_rad", "rotation")):
        errors = metrics.relative_errors(P, Q, kind=kind, times=times, **options.relative)
        found |= _named(key, metrics.statistics_of(errors))
    return found


def _relative_or_none(matched: Matched, part: slice, options: TrajectoryOptions) -> dict[str, Any]:
    """None for a piece too short to hold a pair of poses."""
    try:
        return _relative(matched, part, options)
    except InputError:
        return {"rpe_m": None, "rpe_rad": None}


def _as_printed(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """USME's (2), and of its (5) the root mean square and the median, to the letter."""
    P, Q = matched.estimate, matched.truth
    relative = printed_relative_errors(P, Q, times=matched.times, **options.relative)
    return {
        "ate_printed_m": printed_ate(P, Q, "none").rmse,
        "rpe_printed_m": metrics.statistics_of(relative).rmse,
        "rpe_printed_median_m": float(np.median(relative)),
    }


def _robustness(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """How well the pieces between gaps in time fit together, USME equations (9) and (10)."""
    lost_s = float(np.diff(matched.gaps, axis=1).sum())
    duration = float(matched.times[-1] - matched.times[0])
    breaks = np.flatnonzero(np.diff(matched.piece)) + 1
    # A gap stands as one untracked frame between the pieces.
    rows = np.insert(np.arange(len(matched.piece)), breaks, -1)
    align = "sim3" if options.align == "sim3" else "se3"
    gaps = {
        "gaps": len(matched.gaps),
        "lost_s": lost_s,
        "lost_time_share": lost_s / duration if duration > 0 else 0.0,
    }
    try:
        found = metrics.tracking_robustness(
            matched.raw[rows], matched.truth[rows], rows >= 0, align
        )
    except InputError as error:
        return {"robustness": None, "robustness_reason": str(error), "tracked_pieces": 0, **gaps}
    return {
        "robustness": found.error,
        "robustness_translation_m": found.translation_m,
        "robustness_rotation_rad": found.rotation_rad,
        "robustness_log_scale": found.log_scale,
        "tracked_pieces": len(found.segments),
        **gaps,
    }


def _initialisation(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """When the scale has settled, and how right it is, USME equations (12) and (13)."""
    known = None if options.align == "sim3" else 1.0
    found = metrics.initialisation(matched.times, matched.raw, matched.truth, global_scale=known)
    return {
        "initialisation_s": found.time_s,
        "initialisation_scale": found.scale,
        "scale_error": found.scale_error,
    }
