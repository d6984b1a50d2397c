"""Compare two matched trajectories by every measure of the registry."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.trajectory_files import Matched, TrajectoryOptions, match_files
from ms_slam_env.metrics.relative import (
    printed_ate,
    printed_relative_errors,
)

_ALIGNED = {
    **{"se3": "ate", "sim3": "ate_sim3", "yaw": "ate_yaw"},
    **{"origin": "ate_origin", "none": "ate_unaligned"},
}
"""Alignment over all poses to the metric of the absolute error."""


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
    """Measures of corresponding poses, by registry key.

    Returns:
        ``poses`` and ``unmatched_poses`` of the estimate; ``ate_m`` (RMSE), ``ate_mean_m``,
        ``ate_median_m``, ``ate_std_m``, ``ate_min_m``, ``ate_max_m``, and the same for ``ate_rad``
        (None if the path is a line), ``rpe_m`` and ``rpe_rad``. Alignments other than SE(3) over
        all poses have the key of `absolute_key` instead of ``ate_m``. ``ate_printed_m`` and
        ``rpe_printed_m`` are those of `metrics.relative.printed_errors`. ``tracked_share`` and,
        after SE(3), ``ate_tracked_m`` are given if it is known which frames were tracked;
        ``covered_share`` of the truth's time has poses. Further entries: ``scale`` of the
        alignment, ``path_m``, ``duration_s``, ``pieces`` (the same statistics by piece),
        ``drift_by_length`` (of sub-trajectories), robustness (USME equations 9 and 10 over losses)
        and initialisation (12 and 13).

    Raises:
        InputError: no two poses ``delta`` apart; more segments than poses.
    """
    count = len(matched.times)
    return {
        "poses": count,
        "unmatched_poses": matched.unmatched,
        "tracked_share": matched.tracked_share,
        "covered_share": matched.covered_share,
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
    """Errors (N,) of the aligned poses: metres, and radians if the alignment is unique."""
    ate_m = metrics.absolute_errors(matched.estimate, matched.truth, "none")
    if not matched.alignment.unique:
        return ate_m, None
    return ate_m, metrics.absolute_errors(matched.estimate, matched.truth, "none", "rotation")


def statistic_keys(key: str) -> tuple[str, ...]:
    """Keys of the statistics of an error, in the order of `ErrorStatistics`.

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
    """Key of the absolute error in ``unit`` m or rad; each alignment has its own key.

    ``ate_m``, ``ate_sim3_m``, ``ate_yaw_m``, ``ate_origin_m`` or ``ate_unaligned_m``;
    ``ate_first_m`` if the options align the first poses only.
    """
    name = _ALIGNED[options.align] if options.align_first is None else "ate_first"
    return f"{name}_{unit}"


def _tracked_error(matched: Matched, options: TrajectoryOptions) -> float | None:
    """ATE in metres of the tracked frames, aligned on these frames; None if unknown."""
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


def relative_statistics(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """Statistics of the relative errors over one spacing, ``rpe_m`` and ``rpe_rad`` by key."""
    return _relative(matched, slice(None), options)


def _relative_or_none(matched: Matched, part: slice, options: TrajectoryOptions) -> dict[str, Any]:
    """Relative errors; None for a piece too short to contain a pair of poses."""
    try:
        return _relative(matched, part, options)
    except InputError:
        return {"rpe_m": None, "rpe_rad": None}


def _as_printed(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """ATE and RPE (RMS, median) as Zhang and Scaramuzza define them: see `printed_errors`."""
    P, Q = matched.estimate, matched.truth
    relative = printed_relative_errors(P, Q, times=matched.times, **options.relative)
    return {
        "ate_printed_m": printed_ate(P, Q, "none").rmse,
        "rpe_printed_m": metrics.statistics_of(relative).rmse,
        "rpe_printed_median_m": float(np.median(relative)),
    }


def _robustness(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """How well the pieces between losses fit together, USME equations (9) and (10).

    Where it is not known which frames were tracked, a truth that goes on for longer than a gap
    after the last pose leaves open whether the estimate was lost for good.
    """
    breaks = np.flatnonzero(np.diff(matched.piece)) + 1
    # Each gap is represented by one untracked frame between the pieces.
    rows = np.insert(np.arange(len(matched.piece)), breaks, -1)
    rows = np.concatenate([[-1] * matched.lost_before, rows, [-1] * matched.lost_after]).astype(int)
    ok = rows >= 0 if matched.tracked is None else (rows >= 0) & matched.tracked[rows]
    lost_s = float(np.diff(matched.gaps, axis=1).sum())
    gaps = {
        "gaps": len(matched.gaps),
        "lost_s": lost_s,
        "lost_time_share": lost_s / matched.span_s if matched.span_s > 0 else 0.0,
    }
    align = "sim3" if options.align == "sim3" else "se3"
    reason, pieces = "", 0
    try:
        found = metrics.tracking_robustness(matched.raw[rows], matched.truth[rows], ok, align)
        reason, pieces = found.reason, len(found.segments)
    except InputError as error:
        reason = str(error)
    if not reason and matched.tracked_share is None and matched.ends_early:
        reason = (
            f"the truth goes on for {matched.truth_after_s:.3f} s after the last pose, so the "
            "estimate may have been lost for good; a frames.csv would tell"
        )
    if reason:
        return {"robustness": None, "robustness_reason": reason, "tracked_pieces": pieces, **gaps}
    return {
        "robustness": found.error,
        "robustness_translation_m": found.translation_m,
        "robustness_rotation_rad": found.rotation_rad,
        "robustness_log_scale": found.log_scale,
        "tracked_pieces": pieces,
        **gaps,
    }


def _initialisation(matched: Matched, options: TrajectoryOptions) -> dict[str, Any]:
    """When the scale settled, and how accurate it is, USME equations (12) and (13)."""
    known = None if options.align == "sim3" else 1.0
    found = metrics.initialisation(matched.times, matched.raw, matched.truth, global_scale=known)
    return {
        "initialisation_s": found.time_s,
        "initialisation_scale": found.scale,
        "scale_error": found.scale_error,
    }
