"""Trajectory measures of several robots as one system.

Source: Qu, Zhang, Yang, Dong, "USME: unified SLAM measurement and evaluation", Navigation
Positioning and Timing 2021, equations (14) to (20).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import as_numbers
from ms_slam_env.metrics.relative import motion_errors, relative_errors
from ms_slam_env.metrics.trajectory import (
    ErrorStatistics,
    absolute_errors,
    check_kind,
    check_pair,
    check_times,
    path_length,
    statistics_of,
)


def team_ate(
    estimates: Sequence[ArrayLike],
    truths: Sequence[ArrayLike],
    align: str = "se3",
    kind: str = "translation",
) -> ErrorStatistics:
    """Absolute trajectory error (m or rad) of M robots, USME equations (14) and (15).

    All robots share one alignment, because they should agree on one common world. The RMSE is
    (15).

    Args:
        estimates: M trajectories T_world_camera (N_i, 4, 4) in one world frame; positions (N_i, 3)
            suffice for ``translation``.
        truths: likewise.
        align: ``se3``, ``sim3`` or ``none``.
        kind: ``translation``, metres, or ``rotation``, radians.

    Raises:
        InputError: no robot, numbers or lengths that differ, bad poses, unknown alignment.
    """
    _check_team(estimates, truths)
    check_kind(kind)
    pairs = [
        check_pair(estimate, truth, kind == "rotation", f" of robot {k}")
        for k, (estimate, truth) in enumerate(zip(estimates, truths, strict=True))
    ]
    own, true = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return statistics_of(absolute_errors(own, true, align, kind))


def team_rpe(
    estimates: Sequence[ArrayLike],
    truths: Sequence[ArrayLike],
    delta: float = 1,
    kind: str = "translation",
    unit: str = "frames",
    times: Sequence[ArrayLike] | None = None,
) -> ErrorStatistics:
    """Relative pose error (m or rad) of M robots, USME equations (16) and (17), within each robot.

    For errors between robots see `inter_robot_rpe`. Motions over ``delta`` have the same weight
    for every robot. Arguments are those of `relative_errors`, with ``times`` for each robot.

    Raises:
        InputError: no robot, numbers that differ, or as `relative_errors`.
    """
    _check_team(estimates, truths)
    if times is not None and len(times) != len(truths):
        raise InputError(f"{len(truths)} true trajectories but times of {len(times)} robots")
    errors = [
        relative_errors(
            estimates[k], truths[k], delta, kind, unit, None if times is None else times[k]
        )
        for k in range(len(truths))
    ]
    return statistics_of(np.concatenate(errors))


def inter_robot_errors(
    estimates: Sequence[ArrayLike],
    truths: Sequence[ArrayLike],
    kind: str = "translation",
    times: Sequence[ArrayLike] | None = None,
) -> Float64:
    """Errors (K,) of each robot's pose in the frame of each other robot, at every common time.

    This is another reading of USME equation (16), which our text of the paper lacks: it compares
    states of different robots. With Q_i, Q_j the true poses of two robots at one time and P_i, P_j
    the estimates, E_ij = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j). In `relative_errors`, i and j are two times
    of one robot. No alignment is applied, and each pair counts once.

    Args:
        estimates: M >= 2 trajectories T_world_camera (N_i, 4, 4) in one world frame.
        truths: likewise.
        kind: ``translation``, metres, or ``rotation``, radians.
        times: of each robot (N_i,), seconds, increasing; poses at equal times are compared. If
            None, poses of equal index are, up to the length of the shorter trajectory.

    Raises:
        InputError: fewer than two robots, numbers or lengths that differ, bad poses or times, no
            time that two robots have in common.
    """
    _check_team(estimates, truths)
    check_kind(kind)
    pairs = [
        check_pair(estimate, truth, whose=f" of robot {k}")
        for k, (estimate, truth) in enumerate(zip(estimates, truths, strict=True))
    ]
    if len(pairs) < 2:
        raise InputError("relative poses of robots need at least 2 robots, got 1")
    clocks: list[Float64]
    if times is None:
        clocks = [np.arange(len(own), dtype=np.float64) for own, _ in pairs]
    elif len(times) != len(pairs):
        raise InputError(f"{len(pairs)} true trajectories but times of {len(times)} robots")
    else:
        clocks = [
            check_times(t, len(own), f"times of robot {k}")
            for k, (t, (own, _)) in enumerate(zip(times, pairs, strict=True))
        ]
    errors = []
    for i, j in itertools.combinations(range(len(pairs)), 2):
        _, first, second = np.intersect1d(clocks[i], clocks[j], return_indices=True)
        own, true = (np.concatenate([pairs[i][s][first], pairs[j][s][second]]) for s in (0, 1))
        at = np.arange(len(first))
        errors.append(motion_errors(own, true, at, at + len(first), kind))
    found = np.concatenate(errors)
    if len(found) == 0:
        raise InputError("no two robots overlap in time")
    return found


def inter_robot_rpe(
    estimates: Sequence[ArrayLike],
    truths: Sequence[ArrayLike],
    kind: str = "translation",
    times: Sequence[ArrayLike] | None = None,
) -> ErrorStatistics:
    """Statistics of `inter_robot_errors`, with the same arguments; the RMSE is USME (17)."""
    return statistics_of(inter_robot_errors(estimates, truths, kind, times))


def task_time(times: Sequence[ArrayLike]) -> float:
    """Seconds from the earliest start to the latest end of any robot, USME equation (18).

    Args:
        times: of each robot (N_i,), seconds, increasing.

    Raises:
        InputError: no robot, a robot without times, times that are not finite or do not increase.
    """
    if len(times) == 0:
        raise InputError("no robot given")
    arrays = [as_numbers(t, f"times of robot {k}") for k, t in enumerate(times)]
    for k, array in enumerate(arrays):
        increases = array.ndim == 1 and len(array) > 0 and (np.diff(array) > 0).all()
        if not (increases and np.isfinite(array).all()):
            raise InputError(f"times of robot {k} must be (N,), finite and increase")
    return float(max(array[-1] for array in arrays) - min(array[0] for array in arrays))


def mean_path_length(trajectories: Sequence[ArrayLike]) -> float:
    """Mean length in metres of M robots' paths, USME equations (19) and (20).

    Raises:
        InputError: no robot, or bad poses.
    """
    if len(trajectories) == 0:
        raise InputError("no robot given")
    return float(np.mean([path_length(trajectory) for trajectory in trajectories]))


def _check_team(estimates: Sequence[ArrayLike], truths: Sequence[ArrayLike]) -> None:
    if len(estimates) == 0:
        raise InputError("no robot given")
    if len(estimates) != len(truths):
        raise InputError(f"{len(estimates)} estimates but {len(truths)} true trajectories")
