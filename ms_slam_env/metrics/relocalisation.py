"""How long a SLAM needs to find its pose again after it saw nothing.

Qu, Zhang, Yang, Dong, "USME" (in Chinese), Navigation Positioning and Timing, 2021, section 1.3
(2), equation 11.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.errors import InputError

Float64 = NDArray[np.float64]


def relocalisation_times(timestamps: ArrayLike, black: ArrayLike, tracked: ArrayLike) -> Float64:
    """Time (N,) in seconds from the end of each run of black frames to the next pose.

    Terms of USME equation 11, t_e,i - t_s,i: t_s,i is the time of the first frame after the i-th
    run, t_e,i that of the first frame from then on that is tracked; 0 if they are the same frame.
    Infinite if the next run, or the end, comes first. A run at the very end counts for nothing:
    there was no frame to be found again in.

    Args:
        timestamps: (M,) of the frames, seconds, ascending.
        black: (M,) bool, the frames that were made black.
        tracked: (M,) bool, the frames that SLAM says it has a pose for.

    Raises:
        InputError: arrays of other or unequal shapes, times that are not finite and ascending, or
            no frame at all.
    """
    times = np.asarray(timestamps, dtype=np.float64)
    hidden, found = np.asarray(black, dtype=bool), np.asarray(tracked, dtype=bool)
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


def mean_relocalisation_time(timestamps: ArrayLike, black: ArrayLike, tracked: ArrayLike) -> float:
    """Mean of :func:`relocalisation_times`: USME equation 11, (1/N) sum_i (t_e,i - t_s,i), seconds.

    Infinite if SLAM was not found again after one of the runs, NaN without any run.

    Raises:
        InputError: as there.
    """
    times = relocalisation_times(timestamps, black, tracked)
    return float(times.mean()) if len(times) else float("nan")
