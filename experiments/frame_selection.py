"""Compare active frame management with regular skipping (Saeedi et al., ICRA 2017, V-A)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env import metrics, sequences, slam
from ms_slam_env._runtime.threads import limit_threads
from ms_slam_env.benchmark.episode_scores import LOST_ERROR_M
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import map_quality
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.seen_surface import seen_surface
from ms_slam_env.report.charts import Chart, Guide, Panel, Series
from ms_slam_env.report.tables import (
    Column,
    Grouping,
    Row,
    Table,
    flattened,
    grouped,
    make_table,
    summary,
)
from ms_slam_env.slam.frame_selection import (
    FrameSelectionConfig,
    RegularConfig,
    parse_frame_selection,
)

METRICS = (
    *("processed_share", "ate_m", "ate_tracked_m", "tracked_share", "ate_processed_m"),
    *("f_score_2cm", "astray", "lost_share", "cpu_ms_mean", "filter_cpu_ms"),
)
_PAIRED = {"ate_m": -1, "ate_processed_m": -1, "f_score_2cm": 1}  # 1: more is better
_PANELS = ("ate_m", "ate_processed_m", "f_score_2cm", "cpu_ms_mean")


@dataclass(frozen=True)
class FilterSpec:
    """Several filters on one sequence; see :class:`FrameSelection` for the fields."""

    sequence: str
    managements: tuple[str, ...]
    backend: str = "surfel"
    image_size: str = "160x120"
    frames: int = 300


@dataclass(frozen=True)
class FrameSelection(Experiment, Checked):
    """Active frame management against regular skipping of as many frames

    Compares error and map by the share of frames that SLAM processes, on hand-held sequences with
    calm, walking and fast parts. Astray: a processed frame was more than 0.3 m off.
    """

    sequences: tuple[str, ...] = (
        "living_room:2000",
        "corridor:2001",
        "table:2002",
        "carpet:2003",
        "window:2004",
        "living_room:2005",
        "corridor:2006",
        "table:2007",
    )
    """scene:seed (calm, walking and fast segments), scene:seed:steady, or folders."""
    managements: tuple[str, ...] = (
        "none",
        *(f"regular,every={n}" for n in (2, 3, 4)),
        *(f"divergence,threshold={t}" for t in (0.005, 0.01, 0.02, 0.04)),
        *(f"divergence,threshold={t},reference=previous" for t in (0.001, 0.0025, 0.005, 0.01)),
        *(f"budget,share={s}" for s in (0.5, 0.33, 0.25)),
    )
    """NAME,option=value,... as in the environment option frame_management."""
    backend: str = "surfel"
    """SLAM backend."""
    image_size: str = "160x120"
    """Image size of the camera; recordings are scaled down to it."""
    frames: int = bounded(300, 30, 100_000)
    """Number of frames of a rendered sequence, at 30 Hz."""

    unit = "sequences"

    def specs(self) -> list[FilterSpec]:
        """One spec per sequence."""
        for name in ("sequences", "managements"):
            if not getattr(self, name):
                raise InputError(f"{name} is empty")
        for text in self.managements:
            if parse_frame_selection(text).uses_clock:
                raise InputError(f"{text!r} measures time: no two runs are alike")
        slam.POINT.find(self.backend)
        return self.each(FilterSpec, sequence=self.sequences)

    @staticmethod
    def run(spec: FilterSpec) -> dict[str, Any]:
        """Run every filter, and for each irregular one, regular skipping of as many frames."""
        limit_threads(1)
        path = sequences.UnevenPath(spec.frames)
        opened = sequences.open_sequence(spec.sequence, spec.image_size, path=path, with_truth=True)
        surface = seen_surface(opened)
        frames = tuple(opened.frames)
        sequence = sequences.Sequence(frames, opened.poses, opened.intrinsics, opened.name)
        runs = []
        for text in spec.managements:
            config = parse_frame_selection(text)
            run: dict[str, Any] = {
                "frame_selection": text,
                **measure(config, spec.backend, sequence, surface),
                "regular": None,
            }
            if config.name not in ("none", "regular"):
                every = 1 / run["processed_share"]
                regular = RegularConfig(every=every, max_skip=len(sequence.frames))
                run["regular"] = measure(regular, spec.backend, sequence, surface)
            runs.append(run)
        return {"runs": runs}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians by filter, then every filter compared with regular skipping at equal share."""
        runs = flattened(rows, "runs")
        note = f"Medians over {len({run['spec']['sequence'] for run in runs})} sequences."
        grouping = Grouping(("frame_selection",), METRICS)
        return [grouping.table(runs, note=note), _pairs(runs)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error, map quality and time over the share of frames processed."""
        runs = flattened(rows, "runs")
        caption = "Small dots: sequences; line: medians; dashed: every frame."
        panels = [_panel(runs, key) for key in _PANELS]
        return [Chart("frame_selection", "Cost of dropping frames", caption, panels)]


def measure(
    config: FrameSelectionConfig, backend: str, sequence: sequences.Sequence, surface: Any
) -> dict[str, Any]:
    """Track the sequence from its true first pose behind a filter.

    Args:
        config: configuration of the filter.
        backend: name of the SLAM backend.
        sequence: sequence with ground truth.
        surface: (M, 3) true surface that the frames saw.
    """
    system = config.manage(slam.make(backend, sequence.intrinsics))
    run = run_sequence(system, sequence)
    estimate, kept, truth = run.estimates, run.processed, run.true_poses
    errors = metrics.absolute_errors(estimate[kept], truth[kept], align="none")
    return {
        "frames": len(run),
        "processed_share": float(kept.mean()),
        "lost_share": run.lost,
        "ate_m": metrics.ate_rmse(estimate, truth),
        **metrics.tracked_errors(estimate, truth, run.tracking_ok),
        "ate_processed_m": metrics.ate_rmse(estimate[kept], truth[kept]),
        "largest_error_processed_m": float(errors.max()),
        "astray": bool(errors.max() > LOST_ERROR_M),
        **map_quality(system.surface_points(), surface, ("f_score_2cm", "f_score_5cm")),
        "cpu_ms_mean": float(run.cpu_ms.mean()),
        "filter_cpu_ms": _filter_ms(config, sequence, list(sequence.frames)),
    }


def _filter_ms(
    config: FrameSelectionConfig, sequence: sequences.Sequence, frames: list[RGBDFrame]
) -> float:
    """Processor time of the filter per frame."""
    judge = config.make_filter(sequence.intrinsics)
    judge.admits(frames[0], 0, True)  # buffers grow
    begin = time.process_time()
    for frame in frames:
        judge.admits(frame, 0)
    return 1e3 * (time.process_time() - begin) / len(frames)


def _pairs(runs: Sequence[Row]) -> Table:
    """Each filter, regular skipping at its share, and the share of sequences it is better on."""
    columns: list[Column | str] = ["frame_selection"]
    for key in (*_PAIRED, "astray", "cpu_ms_mean"):
        columns += [key, Column(f"regular_{key}", key, "regular skipping")]
        columns += [Column(f"better_{key}", "better_share")] if key in _PAIRED else []
    lines = []
    compared = [run for run in runs if run["result"]["regular"] is not None]
    for (name,), own in grouped(compared, ("frame_selection",)).items():
        regular = [run["regular"] for run in own]
        line: dict[str, Any] = {"frame_selection": name}
        for key in (*_PAIRED, "astray", "cpu_ms_mean"):
            line |= {key: summary(own, key), f"regular_{key}": summary(regular, key)}
        for key, sign in _PAIRED.items():
            wins = [sign * (a[key] - b[key]) > 0 for a, b in zip(own, regular, strict=True)]
            line[f"better_{key}"] = float(np.mean(wins))
        lines.append(line)
    note = "Beside each filter, regular skipping of as many frames of the same sequences."
    return make_table(columns, lines, "At equal share", note)


def _kind(name: str) -> str:
    """Name of a filter without its first option, which varies along a line."""
    kind, _, options = name.partition(",")
    return ",".join([kind, *options.split(",")[1:]])


def _panel(runs: Sequence[Row], key: str) -> Panel:
    """A measure over the share processed: a dot per run, a line through each kind's medians."""
    by_kind: dict[str, dict[str, list[Row]]] = {}
    for (name,), own in grouped(runs, ("frame_selection",)).items():
        by_kind.setdefault(_kind(name), {})[name] = own
    everything = by_kind.pop("none", {})
    series = []
    for kind, groups in by_kind.items():
        dots = [run for group in groups.values() for run in group]
        x, y = ([run[name] for run in dots] for name in ("processed_share", key))
        series.append(Series(kind, x, y, mode="dots"))
        points = sorted(
            (summary(group, "processed_share").value, summary(group, key).value)
            for group in groups.values()
        )
        series.append(Series(kind, [p for p, _ in points], [q for _, q in points]))
    guides = [Guide(summary(group, key).value, "y", "every frame") for group in everything.values()]
    return Panel("processed_share", key, series, "y" if "ate" in key else "", guides)
