"""SLAM backends side by side: error, time, memory and map on the same sequences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env import metrics, slam
from ms_slam_env.camera import parse_image_size
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import THRESHOLDS_M, map_quality, share_keys
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.seen_surface import open_with_surface
from ms_slam_env.experiments.harness.experiment import Experiment
from ms_slam_env.parallel import limit_threads, thread_environment
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table, finished, make_table
from ms_slam_env.scenes import PUBLISHED_ROOMS
from ms_slam_env.sequences import HandheldPath, check_sequence

DEFAULT_SEQUENCES = (
    "living_room:2000:none",
    *(f"{scene}:2000" for scene in PUBLISHED_ROOMS),
    *(
        f"living_room:2000:kinect+{name}"
        for name in (
            "rolling-shutter",
            "misregistration",
            "auto-exposure",
            "depth-dropout",
            "rolling-shutter+misregistration+auto-exposure+depth-dropout+depth-quantisation",
        )
    ),
)
"""A clean and a noisy room, every scene, and what recordings suffer from, alone and together."""

PEERS = ("odometry,stock=true", "volumetric,stock=true")
"""OpenCV's odometry and Open3D's dense SLAM as they are."""

WARM_UP = 5  # frames left out of the timing: buffers grow, kernels are loaded
MAP_METRICS = (
    *("map_error_median_m", *share_keys(THRESHOLDS_M, ("precision", "f_score"))),
    "map_points",
)
METRICS = (
    *("ate_m", "ate_tracked_m", "ate_max_m", "ate_unaligned_m", "rpe_m", "rpe_rad"),
    "lost_share",
    *("map_error_median_m", "f_score_2cm", "cpu_ms_median", "cpu_ms_p95", "ext_ms_median"),
    *("mem_peak_mb", "ene_frame_j"),
)
MEDIAN = "median"


@dataclass(frozen=True)
class CompareSpec:
    """A backend on a sequence.

    Attributes:
        sequence: a folder, or ``scene:seed[:word[+word ...]]``.
        backend: ``NAME`` or ``NAME,parameter=value,...``.
        image_size: such as 160x120.
        frames: of a rendered sequence.
        speed_m_s: mean speed of the camera of a rendered sequence, where it does not turn.
        turn_deg_s: mean speed of rotation, where it turns.
        threads: cores that the backend may use.
        repeat: runs of one specification are told apart by this number.
    """

    sequence: str
    backend: str
    image_size: str
    frames: int = 200
    speed_m_s: float = 0.5
    turn_deg_s: float = 30.0
    threads: int = 1
    repeat: int = 0


@dataclass(frozen=True)
class Compare(Experiment, Checked):
    """SLAM backends over the same sequences

    Every backend runs over the same images, each in a process of its own; its error is set against
    the time it takes. Down and left is good.
    """

    sequences: tuple[str, ...] = DEFAULT_SEQUENCES
    """Folders, or scene:seed[:word[+word ...]]."""
    backends: tuple[str, ...] = (*slam.BACKENDS, *PEERS)
    """NAME, parameters appended as in surfel,loop_closure=deformation; odometry,stock=true is
    OpenCV's odometry as it is, volumetric,stock=true Open3D's dense SLAM."""
    image_sizes: tuple[str, ...] = ("160x120", "320x240")
    """Such as 160x120."""
    frames: int = bounded(200, 10, 100_000)
    """Of a rendered sequence."""
    speed_m_s: float = 0.5
    """Mean speed of the camera of a rendered sequence, where it does not turn."""
    turn_deg_s: float = 30.0
    """Mean speed of rotation, where it turns."""
    threads: int = bounded(1, 1, 1024)
    """Cores that a backend may use."""
    repeats: int = bounded(1, 1, 1000)
    """Runs of each; the tables show medians."""

    workers = 1
    fresh_process = True
    tracks = True

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        super().__post_init__()
        for name in ("sequences", "backends", "image_sizes"):
            if not getattr(self, name):
                raise InputError(f"{type(self).__name__}.{name} is empty")
        for text in self.sequences:
            check_sequence(text)
        for text in self.backends:
            name, _ = parse_named(text, "backend")
            slam.POINT.find(name)
        for size in self.image_sizes:
            parse_image_size(size)

    def environment(self) -> Mapping[str, str]:
        """Libraries may start as many threads as a backend may use."""
        return thread_environment(self.threads)

    def specs(self) -> list[CompareSpec]:
        """Every run; those of one sequence and size are neighbours."""
        shared = self.frames, self.speed_m_s, self.turn_deg_s, self.threads
        return [
            CompareSpec(sequence, backend, size, *shared, repeat)
            for repeat in range(self.repeats)
            for sequence in self.sequences
            for size in self.image_sizes
            for backend in self.backends
        ]

    @staticmethod
    def run(spec: CompareSpec) -> dict[str, Any]:
        """Track the sequence from its true first pose and measure.

        Costs are those of the frames after the first; memory is the peak that the backend alone
        needs, libraries included, frames not. The map is judged against the surface that the true
        trajectory saw.
        """
        limit_threads(spec.threads)
        path = HandheldPath(spec.frames, speed_m_s=spec.speed_m_s, turn_deg_s=spec.turn_deg_s)
        given = open_with_surface(spec.sequence, spec.image_size, path)
        name, params = parse_named(spec.backend, "backend")
        costs = metrics.CostMeter(str(params.get("device", "cpu")))
        system = slam.make(name, given.intrinsics, **params)
        run = run_sequence(system, given, meter=costs)
        estimates = run.estimates
        ate = metrics.ate_statistics(estimates, given.poses)
        ok = run.tracking_ok
        tracked = metrics.ate_rmse(estimates[ok], given.poses[ok]) if ok.sum() > 1 else None
        return {
            "frames": len(estimates),
            "path_m": metrics.path_length(given.poses),
            "ate_m": ate.rmse,
            "ate_tracked_m": tracked,
            "ate_max_m": ate.max,
            "ate_unaligned_m": metrics.ate_rmse(estimates, given.poses, align="none"),
            "rpe_m": metrics.rpe_rmse(estimates, given.poses),
            "rpe_rad": metrics.rpe_rmse(estimates, given.poses, kind="rotation"),
            "lost_share": run.lost,
            **costs.summary(skip=WARM_UP),
            **map_quality(system.surface_points(), given.surface, MAP_METRICS),
        }

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians of the backends for each image size, then every run."""
        cells = [cell_of(group) for group in groups_of(rows)]
        tables = []
        for size in dict.fromkeys(cell["image_size"] for cell in cells):
            own = [cell for cell in cells if cell["image_size"] == size]
            tables.append(make_table(_columns(own), [*own, *medians(own)], size, _note(own)))
        return tables

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error against processor time, a panel for each image size, a mark for each sequence."""
        panels = []
        for size in dict.fromkeys(row["spec"]["image_size"] for row in finished(rows)):
            own = [row for row in rows if row["spec"]["image_size"] == size]
            panel = scatter(own, "cpu_ms_median", "ate_m", "backend", log="xy")
            panels.append(replace(panel, title=size))
        return [Chart("compare", "Error against time", "One mark a sequence.", panels)]


def groups_of(rows: Sequence[Row]) -> list[list[Row]]:
    """The repeats of each image size, sequence and backend."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        key = tuple(row["spec"][name] for name in ("image_size", "sequence", "backend"))
        groups.setdefault(key, []).append(row)
    return list(groups.values())


def cell_of(repeats: Sequence[Row]) -> dict[str, Any]:
    """Medians over repeats; the error where all failed."""
    spec = repeats[0]["spec"]
    text = spec["sequence"]
    cell: dict[str, Any] = {
        "image_size": spec["image_size"],
        "sequence": Path(text).name if "/" in text else text,
        "backend": spec["backend"],
    }
    results = [row["result"] for row in finished(repeats)]
    if not results:
        return {**cell, "error": repeats[0]["error"]}
    return {**cell, **_medians(results)}


def medians(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Medians over the sequences that every backend finished, a line for each backend."""
    failed = {cell["sequence"] for cell in cells if "error" in cell}
    lines = []
    for backend in dict.fromkeys(cell["backend"] for cell in cells):
        own = [c for c in cells if c["backend"] == backend and c["sequence"] not in failed]
        if own:
            lines.append({"sequence": MEDIAN, "backend": backend, **_medians(own)})
    return lines


def _medians(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    known = {key: [r[key] for r in results if r.get(key) is not None] for key in METRICS}
    return {key: float(np.median(values)) for key, values in known.items() if values}


def _columns(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of a table; energy only where a machine counts it, errors only where there are some."""
    shown = [key for key in (*METRICS, "error") if any(key in cell for cell in cells)]
    return ["sequence", "backend", *shown]


def _note(cells: Sequence[Mapping[str, Any]]) -> str:
    """Over how many sequences the medians are, and which of them are left out."""
    names = list(dict.fromkeys(cell["sequence"] for cell in cells))
    failed = [n for n in names if any(c["sequence"] == n and "error" in c for c in cells)]
    note = f"{MEDIAN.capitalize()}: over {len(names) - len(failed)} of {len(names)} sequences"
    if not failed:
        return f"{note}."
    return f"{note}, those that every backend finished; not {', '.join(failed)}."
