"""Filters in front of SLAM on one sequence, each beside regular skipping of as many frames."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from ms_slam_env import metrics, slam
from ms_slam_env.benchmark.compare_inputs import Input, load
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.experiments.harness.episodes import LOST_ERROR_M
from ms_slam_env.parallel import limit_threads
from ms_slam_env.sequences import UnevenPath
from ms_slam_env.slam.frame_selection import (
    FrameSelectionConfig,
    RegularConfig,
    parse_frame_selection,
)


@dataclass(frozen=True)
class FilterSpec:
    """Several filters on one sequence.

    Attributes:
        sequence: ``scene:seed``, ``scene:seed:steady`` or a folder.
        managements: ``NAME,option=value,...``.
        backend: name of the SLAM.
        image_size: such as 160x120.
        frames: of a rendered sequence.
    """

    sequence: str
    managements: tuple[str, ...]
    backend: str = "surfel"
    image_size: str = "160x120"
    frames: int = 300


def run_filters(spec: FilterSpec) -> dict[str, Any]:
    """Run every filter, and for each that is not regular, regular skipping at the same share.

    Returns:
        ``runs``: for each of the managements what :func:`run_one` measured, with ``management``,
        its text, and ``regular``, the same of regular skipping at the share that the filter had;
        None where the filter is regular itself.
    """
    limit_threads(1)
    given = load(spec.sequence, spec.image_size, UnevenPath(spec.frames))
    runs = []
    for text in spec.managements:
        config = parse_frame_selection(text)
        run: dict[str, Any] = {"management": text, **run_one(config, spec.backend, given)}
        run["regular"] = None
        if config.name not in ("none", "regular"):
            share = run["processed"]
            regular = RegularConfig(every=1 / share, max_skip=len(given.frames))
            run["regular"] = run_one(regular, spec.backend, given)
        runs.append(run)
    return {"runs": runs}


def run_one(config: FrameSelectionConfig, backend: str, given: Input) -> dict[str, Any]:
    """Track the sequence from its true first pose behind a filter and measure.

    Returns:
        ``processed`` and ``lost``, shares of the frames; ``ate_m`` of all frames and
        ``ate_processed_m`` (SE(3)-aligned); ``largest_error_m`` of a processed frame, no alignment,
        and ``failed``, whether it says that tracking went astray; ``f_2cm``, ``f_5cm`` of the map
        where its estimated poses placed it; ``cpu_ms``, processor time a frame, the filter's
        included, and ``filter_ms``, the filter's own.
    """
    system = config.manage(slam.make(backend, given.intrinsics))
    run = run_sequence(system, given)
    estimate, kept = run.estimates, run.processed
    quality = map_quality(system.surface_points(), given.surface, ("f_score_2cm", "f_score_5cm"))
    errors = metrics.absolute_errors(estimate[kept], given.poses[kept], align="none")
    return {
        "frames": len(run),
        "processed": float(kept.mean()),
        "lost": run.lost,
        "ate_m": metrics.ate_rmse(estimate, given.poses),
        "ate_processed_m": metrics.ate_rmse(estimate[kept], given.poses[kept]),
        "largest_error_m": float(errors.max()),
        "failed": bool(errors.max() > LOST_ERROR_M),
        "f_2cm": quality["f_score_2cm"],
        "f_5cm": quality["f_score_5cm"],
        "cpu_ms": float(run.cpu_ms.mean()),
        "filter_ms": _filter_ms(config, given),
    }


def _filter_ms(config: FrameSelectionConfig, given: Input) -> float:
    """Processor time in which the filter judges a frame."""
    judge = config.make_filter(given.intrinsics)
    judge.admits(given.frames[0], 0, True)  # buffers grow
    begin = time.process_time()
    for frame in given.frames:
        judge.admits(frame, 0)
    return 1e3 * (time.process_time() - begin) / len(given.frames)
