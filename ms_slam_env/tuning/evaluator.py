"""Measure a SLAM configuration for an exploration by running it over several sequences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ms_slam_env import metrics, slam
from ms_slam_env.camera import parse_image_size
from ms_slam_env.config import Checked, bounded, chosen
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.seen_surface import SequenceWithSurface, open_with_surface
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.metrics.cost import CostMeter
from ms_slam_env.report.records import spec_key
from ms_slam_env.sequences import HandheldPath, parse_sequence
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.slam.frame_selection import ChangeConfig
from ms_slam_env.slam.frame_selection.filters import Change
from ms_slam_env.tuning.objectives import FAILURE

CLOCKS = {"processor": "cpu_ms_median", "wall": "ext_ms_median"}
"""Clock of the execution time to the meter's key."""

Row = dict[str, Any]

_WARM_UP = 5  # frames left out of the timing, while buffers grow and kernels load
_WARM_UP_FRAMES = 15
_LEAST_ERROR_M = 1e-3  # in ratios; below it, differences between errors are chance


@dataclass(frozen=True)
class SlamEvaluator(Checked):
    """Runs configurations over sequences kept in memory; can be sent to other processes.

    Attributes:
        sequences: folders, or ``scene:seed[:word[+word ...]]``.
        frames: number of frames of a rendered sequence.
        speed_m_s: mean speed of the camera in a rendered sequence, while it does not turn.
        turn_deg_s: mean angular speed while it turns.
        image_size: image size for configurations that do not set one.
        max_lost: share of the frames that tracking may lose before the run counts as failed.
        clock: clock of the execution time: ``processor`` counts all threads but no other programs;
            ``wall`` is the right choice for a GPU.
        map_error: whether to compare maps with the true surface, which takes longer.
        baseline: configuration whose error on each sequence is the unit of ``ate_worst_ratio``.

    Raises:
        InputError: an unknown name, or a value out of range.
    """

    sequences: tuple[str, ...]
    frames: int = bounded(90, 10, 100_000)
    speed_m_s: float = bounded(0.5, 0.0, 10.0)
    turn_deg_s: float = bounded(30.0, 0.0, 1000.0)
    image_size: str = "160x120"
    max_lost: float = bounded(0.02, 0.0, 1.0)
    clock: str = chosen("processor", *CLOCKS)
    map_error: bool = False
    baseline: SlamConfiguration | None = None

    def __post_init__(self) -> None:
        """Refuse settings that no run could use."""
        super().__post_init__()
        if not self.sequences:
            raise InputError("no sequence to explore on")
        for text in self.sequences:
            parse_sequence(text)
        parse_image_size(self.image_size)

    def __call__(self, configuration: SlamConfiguration) -> Row:
        """Measure ``configuration`` on every sequence together; see ``summarise``."""
        rows = [self.measure(configuration, text) for text in self.sequences]
        return summarise(rows, [] if self.baseline is None else _baseline_rows(self))

    def context(self) -> Row:
        """The settings that determine the results, to be stored with a study."""
        return asdict(self)

    def measure(self, configuration: SlamConfiguration, text: str) -> Row:
        """Measure ``configuration`` on one sequence.

        Returns:
            ``ate_m`` (RMSE, SE(3)-aligned), ``ate_tracked_m`` and ``tracked_share`` of the tracked
            frames, ``ate_max_m``, ``ext_ms`` (median time of a processed frame), ``load_ms`` (time
            per frame, counting dropped frames too), ``mem_mb`` (peak memory of SLAM), ``energy_j``
            and ``energy_model_j`` (per processed frame; the latter if the former cannot be
            measured, see `CostMeter`), ``map_error_mm``, ``lost`` (share of the processed frames),
            ``M_I``, ``M_D`` and ``largest_change`` (largest divergences between neighbouring
            processed frames, nats, the last as measured by adaptation and frame selection),
            ``frames``; None or missing if not available. ``failure`` is a text if tracking was
            lost too often or SLAM crashed.

        Raises:
            InputError: a sequence that cannot be read, or parameters that the backend refuses.
        """
        size = configuration.image_size or self.image_size
        path = HandheldPath(self.frames, speed_m_s=self.speed_m_s, turn_deg_s=self.turn_deg_s)
        given = _load(text, size, path)
        every = configuration.keep_every
        row: Row = {"sequence": text, **_divergences(text, size, path, every)}
        _warm_up(
            configuration.slam, size, str(configuration.slam_config.get("device", "cpu")), given
        )
        try:
            with configuration.machine():
                return {**row, **self._run(configuration, given)}
        except InputError:
            raise
        except (RuntimeError, ArithmeticError, ValueError, MemoryError) as error:
            return {**row, "lost": 1.0, FAILURE: f"{text}: {error or type(error).__name__}"}

    def _run(self, configuration: SlamConfiguration, given: SequenceWithSurface) -> Row:
        device = str(configuration.slam_config.get("device", "cpu"))
        meter = CostMeter(device)
        system = slam.make(configuration.slam, given.intrinsics, **configuration.slam_config)
        every = configuration.keep_every
        frames, truth = given.frames[::every], given.poses[::every]
        run = run_sequence(system, frames, start=truth[0], meter=meter)
        ate = metrics.ate_statistics(run.estimates, truth)
        costs = meter.summary(min(_WARM_UP, len(run) - 1))
        ext_ms = costs[CLOCKS[self.clock]]
        row: Row = {
            "frames": len(run),
            "ate_m": ate.rmse,
            **metrics.tracked_errors(run.estimates, truth, run.tracking_ok),
            "ate_max_m": ate.max,
            "ext_ms": ext_ms,
            "load_ms": ext_ms * len(run) / len(given.frames),
            "mem_mb": costs["mem_peak_mb"],
            "energy_j": costs["ene_frame_j"],
            "energy_model_j": costs.get("ene_model_frame_j"),
            "lost": run.lost,
        }
        if self.map_error:
            row["map_error_mm"] = _map_error_mm(system.surface_points(), given.surface)
        if not math.isfinite(ate.rmse):
            row[FAILURE] = "the trajectory is not finite"
        elif run.lost > self.max_lost:
            row[FAILURE] = f"tracking lost in {100 * run.lost:.0f} % of the frames"
        return row


def summarise(rows: Sequence[Row], baseline: Sequence[Row] = ()) -> Row:
    """One row for all sequences: means, the largest of maxima and memory, and any failure.

    ``ate_worst_m`` is the largest error of a sequence, ``ate_worst_ratio`` the largest ratio of a
    sequence's error to its ``baseline``.
    """
    largest = ("ate_max_m", "mem_mb", "lost", "M_I", "M_D", "largest_change")
    errors = ("ate_m", "ate_tracked_m", "tracked_share", "map_error_mm")
    means = (*errors, "ext_ms", "load_ms", "energy_j", "energy_model_j")
    result: Row = {}
    for name in (*means, *largest):
        values = [row.get(name) for row in rows]
        known = [value for value in values if value is not None]
        if len(known) == len(rows):
            result[name] = float(np.max(known) if name in largest else np.mean(known))
    if "ate_m" in result:
        result["ate_worst_m"] = max(row["ate_m"] for row in rows)
        if baseline:
            result["ate_worst_ratio"] = worst_ratio(rows, baseline)
    failures = [f"{row['sequence']}: {row[FAILURE]}" for row in rows if row.get(FAILURE)]
    if failures:
        result[FAILURE] = "; ".join(failures)
    return result


def worst_ratio(rows: Sequence[Row], baseline: Sequence[Row]) -> float:
    """Largest ratio of a sequence's error to the baseline's on it; NaN without sequences.

    Errors below 1 mm count as 1 mm, so that a sequence with a tiny error does not dominate.
    """
    pairs = [(a.get("ate_m"), b.get("ate_m")) for a, b in zip(rows, baseline, strict=True)]
    least = _LEAST_ERROR_M
    known = ((own, its) for own, its in pairs if own is not None and its is not None)
    return max((max(own, least) / max(its, least) for own, its in known), default=math.nan)


_BASELINES: dict[str, list[Row]] = {}


def _baseline_rows(evaluator: SlamEvaluator) -> list[Row]:
    """Results of ``evaluator``'s baseline on its sequences, computed once per process."""
    key = spec_key(evaluator)
    if key not in _BASELINES:
        assert evaluator.baseline is not None
        _BASELINES[key] = [evaluator.measure(evaluator.baseline, s) for s in evaluator.sequences]
    return _BASELINES[key]


@lru_cache(maxsize=64)
def _load(text: str, size: str, path: HandheldPath) -> SequenceWithSurface:
    return open_with_surface(text, size, path)


@lru_cache(maxsize=1024)
def _divergences(text: str, size: str, path: HandheldPath, every: int) -> dict[str, float]:
    """Largest divergences between neighbouring processed frames: equations (11), (12), and sum."""
    given = _load(text, size, path)
    frames = given.frames[::every]
    if len(frames) < 2:
        raise InputError(f"sequence {text}: every {every}th of {len(given.frames)} frames is one")
    values = consecutive_divergences(frames, given.intrinsics, [DivergenceConfig()])[:, 0]
    change = Change(ChangeConfig(), given.intrinsics)
    changes = []
    for frame in frames:
        changes.append(change.measure(frame))
        change.keep()
    largest = float(np.max(changes[1:]))
    return {**dict(zip(("M_I", "M_D"), values.max(axis=0).tolist(), strict=True)),
            "largest_change": largest}  # fmt: skip


_WARM: set[tuple[str, str, str]] = set()


def _warm_up(backend: str, size: str, device: str, given: SequenceWithSurface) -> None:
    """Run the backend once in this process before any timed run, to load kernels."""
    if (backend, size, device) not in _WARM:
        _WARM.add((backend, size, device))
        system = slam.make(
            backend, given.intrinsics, **({} if device == "cpu" else {"device": device})
        )
        run_sequence(system, given.frames[:_WARM_UP_FRAMES], start=given.poses[0])


def _map_error_mm(points: np.ndarray, surface: np.ndarray) -> float | None:
    """Median distance of a map point to the true surface, millimetres; None for an empty map."""
    found = map_quality(points, surface, ("map_error_median_m",))["map_error_median_m"]
    return None if math.isnan(found) else 1e3 * found
