"""Robustness and initialisation: how well the tracked pieces of a trajectory fit together, how
long SLAM is lost, when the scale of an estimate settles, and how accurate it is then.

Source: Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation
Positioning and Timing 2021, equations (9) to (13); after Li et al., "Survey and evaluation of
monocular visual-inertial SLAM algorithms for augmented reality", 2019. The typeset formulas are
missing from our text of USME; these are what its words say, as in Li et al.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import logm

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import as_numbers
from ms_slam_env.geometry.point_clouds import umeyama, umeyama_scales
from ms_slam_env.metrics.trajectory import check_pair, check_positions, check_positive

SEGMENT_ALIGNMENTS = ("se3", "sim3")
_POINTS_AT_ONCE = 200_000  # of all windows whose scales are computed in one batch


@dataclass(frozen=True)
class TrackingRobustness:
    """How well the tracked pieces of a trajectory fit together.

    Attributes:
        error: USME equation (10), the sum over neighbouring pieces of |log(xi_i^-1 xi_i+1)|;
            metres, radians and, with scale, logarithms of scales are added without weights. None
            if some loss has no piece before or after it, which the sum would pass over: a system
            that is lost for good has one piece and an empty sum.
        translation_m: sum of the translation parts; None likewise.
        rotation_rad: sum of the rotation parts; None likewise.
        log_scale: sum of the scale parts; None likewise.
        segments: (K, 2) first frame and frame after the last of each piece.
        lost: share of the frames outside the pieces.
        reason: why there is no error; empty if there is one.
    """

    error: float | None
    translation_m: float | None
    rotation_rad: float | None
    log_scale: float | None
    segments: NDArray[np.int64]
    lost: float
    reason: str = ""


def tracked_segments(tracked: ArrayLike, shortest: int = 3) -> NDArray[np.int64]:
    """Runs of tracked frames, (K, 2): first frame and frame after the last.

    Args:
        tracked: (N,) bool.
        shortest: leave out runs of fewer frames.

    Raises:
        InputError: wrong shape or type, or no frame.
    """
    flags = np.asarray(tracked)
    if flags.ndim != 1 or flags.dtype != np.bool_ or len(flags) == 0:
        raise InputError(f"tracked must be (N,) bool, got {flags.shape} {flags.dtype}")
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    segments = edges.reshape(-1, 2)
    return segments[segments[:, 1] - segments[:, 0] >= shortest]


def tracking_robustness(
    estimate: ArrayLike,
    truth: ArrayLike,
    tracked: ArrayLike,
    align: str = "se3",
    lever_m: float = 1.0,
) -> TrackingRobustness:
    """Align every tracked piece with the truth and compare neighbouring alignments.

    Args:
        estimate: T_world_camera (N, 4, 4).
        truth: likewise.
        tracked: (N,) bool, whether the frame was tracked.
        align: ``se3``, or ``sim3`` for systems without scale.
        lever_m: each pose is represented by its position and the three points this far along its
            axes. 0 gives USME's equation (9), positions alone, which leaves the roll of a straight
            piece and the rotation of a stationary one undetermined.

    Raises:
        InputError: bad poses, lengths that differ, an unknown alignment, a negative lever;
            ``sim3`` if estimate or truth stands still in a piece.
    """
    if align not in SEGMENT_ALIGNMENTS:
        raise unknown("alignment", align, SEGMENT_ALIGNMENTS)
    if not (np.isfinite(lever_m) and lever_m >= 0):
        raise InputError(f"lever_m must be finite and >= 0, got {lever_m}")
    poses, true_poses = check_pair(estimate, truth)
    segments = tracked_segments(tracked)
    if not len(poses) == len(true_poses) == len(np.asarray(tracked)):
        raise InputError(
            f"estimate has {len(poses)} poses, truth {len(true_poses)}, tracked "
            f"{len(np.asarray(tracked))} flags; they must correspond"
        )
    covered = int((segments[:, 1] - segments[:, 0]).sum())
    lost, reason = 1.0 - covered / len(poses), _unjoined_loss(segments, len(poses))
    if reason:
        return TrackingRobustness(None, None, None, None, segments, lost, reason)
    similarities = []
    for first, end in segments:
        own, true = poses[first:end], true_poses[first:end]
        scale = umeyama(own[:, :3, 3], true[:, :3, 3], True)[2] if align == "sim3" else 1.0
        if not scale > 0:
            raise InputError(f"the truth stands still in frames {first} to {end - 1}: no scale")
        points = _levers(own, lever_m / scale)
        R, t, scale = umeyama(points, _levers(true, lever_m), align == "sim3")
        S = np.eye(4)
        S[:3, :3], S[:3, 3] = scale * R, t
        similarities.append(S)  # (9)
    parts = np.array(
        [similarity_log(np.linalg.inv(a) @ b) for a, b in itertools.pairwise(similarities)]
    ).reshape(-1, 7)
    return TrackingRobustness(
        error=float(np.linalg.norm(parts, axis=1).sum()),  # (10)
        translation_m=float(np.linalg.norm(parts[:, :3], axis=1).sum()),
        rotation_rad=float(np.linalg.norm(parts[:, 3:6], axis=1).sum()),
        log_scale=float(np.abs(parts[:, 6]).sum()),
        segments=segments,
        lost=lost,
    )


def _unjoined_loss(segments: NDArray[np.int64], frames: int) -> str:
    """Which loss has no piece before or after it; empty if none."""
    if len(segments) == 0:
        return "no piece of at least 3 frames was tracked"
    if segments[-1, 1] < frames:
        return "no piece follows the last loss"
    return "no piece precedes the first loss" if segments[0, 0] > 0 else ""


def similarity_log(S: ArrayLike) -> Float64:
    """Twist (7,) of a similarity (4, 4) [[s R, t], [0, 1]]: rho (m), phi (rad), log s.

    Unique for rotations below pi.
    """
    generator = np.real(logm(np.asarray(S, dtype=np.float64)))
    phi = [generator[2, 1], generator[0, 2], generator[1, 0]]
    return np.array([*generator[:3, 3], *phi, np.trace(generator[:3, :3]) / 3])


def _levers(poses: Float64, lever_m: float) -> Float64:
    """Points (4 N, 3): the positions of poses, and the points ``lever_m`` along their axes."""
    position = poses[:, None, :3, 3]
    axes = np.swapaxes(poses[:, :3, :3], 1, 2)
    return np.concatenate([position, position + lever_m * axes], axis=1).reshape(-1, 3)


def relocalisation_times(timestamps: ArrayLike, black: ArrayLike, tracked: ArrayLike) -> Float64:
    """Time (N,) in seconds from the end of each run of black frames to the next pose.

    Terms t_e,i - t_s,i of USME equation (11): t_s,i is the time of the first frame after the i-th
    run, t_e,i the time of the first tracked frame from there on; 0 if they are the same frame.
    Infinite if the next run or the end of the sequence comes first. A run at the end of the
    sequence is ignored, since no frame follows in which SLAM could relocalise.

    Args:
        timestamps: (M,) of the frames, seconds, ascending.
        black: (M,) bool, frames replaced by black ones.
        tracked: (M,) bool, frames for which SLAM reports a pose.

    Raises:
        InputError: arrays of wrong or unequal shapes, times that are not finite and ascending, or
            no frame at all.
    """
    times = as_numbers(timestamps, "timestamps")
    hidden, found = (as_numbers(one, "black, tracked") != 0 for one in (black, tracked))
    if times.ndim != 1 or len(times) == 0 or not times.shape == hidden.shape == found.shape:
        raise InputError(
            f"timestamps {times.shape}, black {hidden.shape} and tracked {found.shape} must be of "
            "one length, at least 1"
        )
    if not np.isfinite(times).all() or (np.diff(times) < 0).any():
        raise InputError("timestamps must be finite and ascending")
    starts = np.flatnonzero(hidden[:-1] & ~hidden[1:]) + 1  # first frames that see again
    ends = np.append(np.flatnonzero(~hidden[:-1] & hidden[1:]) + 1, len(times))
    result = np.full(len(starts), np.inf)
    for index, start in enumerate(starts):
        end = ends[ends > start][0]
        poses = np.flatnonzero(found[start:end])
        if len(poses):
            result[index] = times[start + poses[0]] - times[start]
    return result


@dataclass(frozen=True)
class Relocalisation:
    """USME equation (11) over runs of black frames, counting failures separately.

    Attributes:
        mean_s: mean time of the runs after which SLAM relocalised, seconds; NaN if it never did.
        found: number of runs after which SLAM relocalised.
        never: number of the other runs, which have no time.
    """

    mean_s: float
    found: int
    never: int


def relocalisation(timestamps: ArrayLike, black: ArrayLike, tracked: ArrayLike) -> Relocalisation:
    """Mean of the finite `relocalisation_times`, with counts of finite and infinite ones.

    Raises:
        InputError: as `relocalisation_times`.
    """
    times = relocalisation_times(timestamps, black, tracked)
    found = times[np.isfinite(times)]
    mean = float(found.mean()) if len(found) else float("nan")
    return Relocalisation(mean, len(found), len(times) - len(found))


def mean_relocalisation_time(timestamps: ArrayLike, black: ArrayLike, tracked: ArrayLike) -> float:
    """Mean of `relocalisation_times`: USME equation (11), (1/N) sum_i (t_e,i - t_s,i), seconds.

    Infinite (written and shown as "never") if SLAM failed to relocalise after any run, NaN without
    a run. `relocalisation` counts successes and failures separately.

    Raises:
        InputError: as `relocalisation_times`.
    """
    times = relocalisation_times(timestamps, black, tracked)
    return float(times.mean()) if len(times) else float("nan")


@dataclass(frozen=True)
class Initialisation:
    """When and how accurately a trajectory's scale settled.

    Attributes:
        time_s: from the first pose to the end of initialisation; None if the scale never settles.
        scale: s(t_init), the scale at that time; None likewise.
        scale_error: symmetric relative scale error, USME equation (13), 0 if the scale is right;
            None likewise.
    """

    time_s: float | None
    scale: float | None
    scale_error: float | None


def local_scales(
    times: ArrayLike, estimate: ArrayLike, truth: ArrayLike, window_s: float
) -> Float64:
    """Scale s(t) (N,) of the estimate around every pose: metres of truth per unit of estimate.

    Umeyama's scale over the poses at most ``window_s`` / 2 away; NaN if there are fewer than 3, or
    if the estimate or the truth stands still.

    Raises:
        InputError: bad positions, times that do not increase, lengths that differ, a window that is
            not positive.
    """
    positions, true_positions = check_pair(estimate, truth, need_poses=False)
    seconds = as_numbers(times, "times")
    if seconds.shape != (len(positions),) or not (np.diff(seconds) > 0).all():
        raise InputError(f"times must be ({len(positions)},) and increase")
    check_positive(window_s, "window_s")
    first = np.searchsorted(seconds, seconds - window_s / 2, "left")
    count = np.searchsorted(seconds, seconds + window_s / 2, "right") - first
    scales = np.full(len(positions), np.nan)
    for size in np.unique(count[count >= 3]):
        own = np.flatnonzero(count == size)
        for part in np.array_split(own, len(own) * int(size) // _POINTS_AT_ONCE + 1):
            rows = first[part, None] + np.arange(size)
            moves = np.ptp(positions[rows], axis=1).max(axis=1) > 1e-9
            part, rows = part[moves], rows[moves]
            scales[part] = umeyama_scales(positions[rows], true_positions[rows])
    return np.where(scales > 0, scales, np.nan)


def initialisation(
    times: ArrayLike,
    estimate: ArrayLike,
    truth: ArrayLike,
    window_s: float = 1.0,
    settled_s: float = 2.0,
    threshold: float = 0.05,
    global_scale: float | None = None,
) -> Initialisation:
    """Time and scale error of initialisation.

    The largest relative scale in [t, t + settled_s], equation (12), is computed as
    r(t) = max s / min s - 1; initialisation ends at the first t at which it is below ``threshold``.
    The error at that time, equation (13), is (|s_g / s - 1| + |s / s_g - 1|) / 2. (Our text of USME
    lacks the formulas; these are those of Li et al., on which it builds.)

    Args:
        times: (N,) seconds, increasing.
        estimate: T_world_camera (N, 4, 4) or positions (N, 3), from the first valid pose on.
        truth: likewise.
        window_s: length of the window of poses that each local scale is computed from, seconds.
        settled_s: time for which the scale must stay constant, seconds.
        threshold: r_init, the largest relative change of a settled scale.
        global_scale: s_g; None for the scale that best aligns the whole trajectory, 1 for systems
            with known scale (stereo, RGB-D, inertial).

    Raises:
        InputError: as `local_scales`; a threshold, duration or scale that is not positive.
    """
    options = {"settled_s": settled_s, "threshold": threshold, "global_scale": global_scale}
    for name, value in options.items():
        if value is not None:
            check_positive(value, name)
    scales = local_scales(times, estimate, truth, window_s)
    seconds = as_numbers(times, "times")
    if global_scale is None:
        positions = check_positions(estimate, "estimate")
        global_scale = umeyama(positions, check_positions(truth, "truth"), with_scale=True)[2]
    end = np.searchsorted(seconds, seconds + settled_s, "right")
    first = np.flatnonzero(seconds[-1] - seconds >= settled_s)
    if len(first) == 0:
        return Initialisation(None, None, None)
    spans = np.stack([first, end[first]], axis=1).ravel()
    padded = np.append(scales, np.nan)
    largest, least = (of.reduceat(padded, spans)[::2] for of in (np.maximum, np.minimum))
    settled = first[largest / least - 1 < threshold]  # (12); NaN is never below
    if len(settled) == 0:
        return Initialisation(None, None, None)
    k = settled[0]
    ratio = scales[k] / global_scale
    error = (abs(1 / ratio - 1) + abs(ratio - 1)) / 2  # (13)
    return Initialisation(float(seconds[k] - seconds[0]), float(scales[k]), float(error))
