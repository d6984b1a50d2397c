"""When the scale of an estimated trajectory has settled, and how right it is then.

Source: Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation
Positioning and Timing 2021, equations (12) and (13); after Li et al., "Survey and evaluation of
monocular visual-inertial SLAM algorithms for augmented reality", 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env.errors import InputError
from ms_slam_env.geometry import Float64
from ms_slam_env.geometry.point_clouds import umeyama
from ms_slam_env.metrics.trajectory import check_pair, check_positions, check_positive


@dataclass(frozen=True)
class Initialisation:
    """How a trajectory's scale settled.

    Attributes:
        time_s: from the first pose to the end of initialisation; None if the scale never settles.
        scale: s(t_init) there; None likewise.
        scale_error: symmetric relative scale error, USME equation (13), 0 where the scale is
            right; None likewise.
    """

    time_s: float | None
    scale: float | None
    scale_error: float | None


def local_scales(
    times: ArrayLike, estimate: ArrayLike, truth: ArrayLike, window_s: float
) -> Float64:
    """Scale s(t) (N,) of the estimate around every pose: metres of truth per unit of estimate.

    Umeyama's scale of the poses at most ``window_s`` / 2 away; NaN where fewer than 3 are, or
    where the estimate or the truth stands still.

    Raises:
        InputError: bad positions, times that do not increase, lengths that differ, a window that is
            not positive.
    """
    positions, true_positions = check_pair(estimate, truth, need_poses=False)
    seconds = np.asarray(times, dtype=np.float64)
    if seconds.shape != (len(positions),) or not (np.diff(seconds) > 0).all():
        raise InputError(f"times must be ({len(positions)},) and increase")
    check_positive(window_s, "window_s")
    first = np.searchsorted(seconds, seconds - window_s / 2, "left")
    end = np.searchsorted(seconds, seconds + window_s / 2, "right")
    scales = np.full(len(positions), np.nan)
    for k, (a, b) in enumerate(zip(first, end, strict=True)):
        if b - a >= 3 and np.ptp(positions[a:b], axis=0).max() > 1e-9:
            scales[k] = umeyama(positions[a:b], true_positions[a:b], with_scale=True)[2]
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

    The largest relative scale in [t, t + settled_s], equation (12), is taken as
    r(t) = max s / min s - 1; the first t at which it is below ``threshold`` ends initialisation.
    The error there, equation (13), is (|s_g / s - 1| + |s / s_g - 1|) / 2. (The text that we have
    of USME lacks its formulas; these are those of Li et al., on which it builds.)

    Args:
        times: (N,) seconds, increasing.
        estimate: T_world_camera (N, 4, 4) or positions (N, 3); the first is the first valid pose.
        truth: likewise.
        window_s: of poses that a scale is taken from.
        settled_s: how long the scale must keep.
        threshold: r_init, the largest relative change of a settled scale.
        global_scale: s_g; None for the scale that best aligns the whole trajectory, 1 for systems
            that know scale (stereo, RGB-D, inertial).

    Raises:
        InputError: as `local_scales`; a threshold, duration or scale that is not positive.
    """
    options = {"settled_s": settled_s, "threshold": threshold, "global_scale": global_scale}
    for name, value in options.items():
        if value is not None:
            check_positive(value, name)
    scales = local_scales(times, estimate, truth, window_s)
    seconds = np.asarray(times, dtype=np.float64)
    if global_scale is None:
        positions = check_positions(estimate, "estimate")
        global_scale = umeyama(positions, check_positions(truth, "truth"), with_scale=True)[2]
    end = np.searchsorted(seconds, seconds + settled_s, "right")
    for k, last in enumerate(end):
        if seconds[-1] - seconds[k] < settled_s:
            break
        within = scales[k:last]
        if np.isfinite(within).all() and within.max() / within.min() - 1 < threshold:  # (12)
            ratio = scales[k] / global_scale
            error = (abs(1 / ratio - 1) + abs(ratio - 1)) / 2  # (13)
            return Initialisation(float(seconds[k] - seconds[0]), float(scales[k]), float(error))
    return Initialisation(None, None, None)
