"""Two trajectory files compared: ATE and RPE of the poses that correspond in time."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ms_slam_env import metrics
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import associate, read_trajectory


def evaluate_files(
    estimate: Path, truth: Path, align: str = "se3", delta: int = 1, max_difference_s: float = 0.02
) -> dict[str, Any]:
    """Compare TUM file ``estimate`` with TUM file ``truth``.

    Args:
        estimate: estimated T_world_camera.
        truth: true T_world_camera.
        align: ``se3``, ``sim3`` or ``none``, for ATE.
        delta: frames between the poses of a relative error.
        max_difference_s: largest difference between timestamps that correspond.

    Returns:
        number of ``poses`` that correspond, and statistics ``ate_m``, ``rpe_m``, ``rpe_rad``.

    Raises:
        InputError: a file that cannot be read, fewer than two poses in common, a bad option.
    """
    times, poses = read_trajectory(estimate)
    true_times, true_poses = read_trajectory(truth)
    first, second = associate(times, true_times, max_difference_s)
    if len(first) < 2:
        raise InputError(
            f"{estimate} and {truth} have {len(first)} timestamps in common "
            f"(at most {max_difference_s} s apart); at least 2 are needed"
        )
    P, Q = poses[first], true_poses[second]
    return {
        "estimate": str(estimate),
        "truth": str(truth),
        "align": align,
        "delta": delta,
        "poses": len(first),
        "ate_m": asdict(metrics.ate_statistics(P, Q, align)),
        "rpe_m": asdict(metrics.rpe_statistics(P, Q, delta)),
        "rpe_rad": asdict(metrics.rpe_statistics(P, Q, delta, kind="rotation")),
    }
