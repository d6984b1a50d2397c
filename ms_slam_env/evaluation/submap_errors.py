"""Errors of the submaps of a run against the truth, separately and after joining."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64, Int32
from ms_slam_env._runtime.output_files import write_text
from ms_slam_env.evaluation.run_sequence import SequenceRun

_FEWEST = 3  # poses needed for an alignment


def submap_numbers(run: SequenceRun) -> Int32:
    """Submap (N,) of each frame at the end: the oldest one it is joined to; -1 if lost."""
    own = np.array([result.submap for result in run.results], dtype=np.int32).reshape(-1)
    return np.where(run.tracking_ok, run.backend.submaps().joined_to[own], -1).astype(np.int32)


def submap_measures(run: SequenceRun) -> dict[str, Any]:
    """``submaps``, ``joined_submaps`` and ``unjoined_share`` of a run."""
    submaps, numbers = run.backend.submaps(), submap_numbers(run)
    return {
        "submaps": len(submaps),
        "joined_submaps": int((submaps.joined_at >= 0).sum()),
        "unjoined_share": float((numbers > 0).mean()),
    }


def submap_errors(poses: Float64, truth: Float64, numbers: Int32) -> dict[str, float]:
    """Errors of the submaps of final poses (N, 4, 4) against the true ones (N, 4, 4).

    ``joined_ate_m`` covers the frames in the first submap and in those joined to it;
    ``submap_ate_m`` all tracked frames, with each submap aligned separately. Submaps of fewer than
    three poses are left out; a measure without data is missing.
    """
    squares: list[Float64] = []
    found: dict[str, float] = {}
    for number in np.unique(numbers[numbers >= 0]):
        chosen = numbers == number
        if chosen.sum() < _FEWEST:
            continue
        error = metrics.ate_rmse(poses[chosen], truth[chosen])
        squares.append(np.full(int(chosen.sum()), error**2))
        if number == 0:
            found["joined_ate_m"] = error
    if squares:
        found["submap_ate_m"] = float(np.sqrt(np.concatenate(squares).mean()))
    return found


def paths_by_submap(poses: Float64, numbers: Int32) -> Mapping[str, Float64]:
    """Positions (N, 3) by submap, NaN for frames in other submaps."""
    return {
        f"submap {number}": np.where((numbers == number)[:, None], poses[:, :3, 3], np.nan)
        for number in np.unique(numbers[numbers >= 0])
    }


def write_submaps(path: Path, run: SequenceRun) -> None:
    """Write as CSV the submap that each frame was tracked in, and the one it is part of at the end.

    The last two columns are the standard deviations (metres, degrees) of the submap's pose along
    its most uncertain direction; 0 if it is joined to the first.
    """
    lines = ["timestamp,submap,joined_to,sigma_m,sigma_deg"]
    numbers = submap_numbers(run)
    links = run.backend.submaps().links
    for time, result, number in zip(run.timestamps, run.results, numbers, strict=True):
        link = links[number] if number > 0 else np.zeros((6, 6))
        sigmas = [float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in _parts(link)]
        words = [f"{sigmas[0]:.4f}", f"{np.degrees(sigmas[1]):.3f}"]
        own = result.submap if result.tracking_ok else -1
        lines.append(",".join([f"{time:.6f}", str(own), str(number), *words]))
    write_text(path, "\n".join(lines) + "\n")


def _parts(link: Float64) -> tuple[Float64, Float64]:
    """Blocks (3, 3) of translation and rotation."""
    return link[:3, :3], link[3:, 3:]
