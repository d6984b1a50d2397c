"""The eight sequences of the USME framework, SLAM backends judged by all of its measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from ms_slam_env import slam
from ms_slam_env._runtime.parallel import limit_threads, thread_environment
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.benchmark.usme_runs import UsmeSpec, run_usme
from ms_slam_env.camera import rendered_size
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table, finished, make_table, measured
from ms_slam_env.sequences.usme_suite import NAMES, SUITE, find, made_with

TABLES: Mapping[str, tuple[str, ...]] = {
    "Accuracy": (
        *("path_m", "ate_m", "ate_tracked_m", "tracked_share", "ate_max_m", "final_ate_m"),
        *("end_error_m", "end_error_share", "rpe_m", "rpe_rad"),
    ),
    "Map": (
        *("map_points", "c2c_mean_m", "c2c_std_m", "hausdorff_directed_m", "recall_near"),
        *("noise_ratio", "spacing_m"),
    ),
    "Robustness": (
        *("lost_share", "robustness", "relocalisation_s", "initialisation_s", "scale_error"),
    ),
    "Loops": (
        *("revisits", "revisiting_frames", "stated_loops", "closed_loops"),
        *("loop_precision", "loop_recall"),
    ),
    "Cost": (
        *("frames", "ext_ms", "ext_ms_p95", "cpu_ms_mean", "mem_peak_mb", "ene_frame_j"),
        *("ene_source", "ene_model_frame_j", "energy_source"),
    ),
}


_OPTIONS: Mapping[str, Any] = {"image_size": "160x120", "seed": 2000, "frames_scale": 1.0}
"""What a sequence without a folder is made with, unless told otherwise."""


@dataclass(frozen=True)
class Usme(Experiment, Checked):
    """SLAM backends over the eight sequences of the USME framework

    Four kinds of scenes (streets, factory hall, room), with and without loops, motion blur, moving
    objects, fast motion and black frames. Every run has a process of its own. Streets and hall take
    other parameters than a room, and where something moves surfel has ``motion_mask=geometric``.
    """

    folder: tyro.conf.Positional[Path | None] = None
    """Folder that ms-slam usme make wrote; without it every frame is rendered when it is needed."""
    backends: tuple[str, ...] = (
        *("surfel", "surfel,loop_closure=deformation"),
        *("sparse", "volumetric", "kinectfusion", "odometry"),
    )
    """NAME, parameters appended as in surfel,loop_closure=deformation."""
    sequences: tuple[str, ...] = ()
    """Their names; by default all, or those that the folder holds."""
    image_size: str | None = None
    """Such as 160x120; by default that of the folder, or this."""
    seed: int | None = bounded(None, 0, 2**32 - 1)
    """Of scenes, paths, noise and perturbations; by default that of the folder, or 2000."""
    frames_scale: float | None = bounded(None, 0.002, 10.0)
    """Share of the frames that the same paths take: 0.5 halves the work and doubles the camera's
    speed; by default that of the folder, or 1."""

    workers = 1
    fresh_process = True
    tracks = True

    def __post_init__(self) -> None:
        """Refuse what cannot be rendered."""
        super().__post_init__()
        check_suite(self.sequences or NAMES, self.image_size or _OPTIONS["image_size"])

    def environment(self) -> Mapping[str, str]:
        """One thread a run."""
        return thread_environment(1)

    def specs(self) -> list[UsmeSpec]:
        """Every run.

        Raises:
            InputError: an unknown backend or parameter, or a folder that lacks a sequence or holds
                another.
        """
        for text in self.backends:
            slam.check_parameters(*parse_named(text, "backend"))
        made = {name: self._options(name) for name in self._names()}
        return [
            UsmeSpec(sequence, backend, **options)
            for sequence, options in made.items()
            for backend in self.backends
        ]

    def _names(self) -> tuple[str, ...]:
        """The sequences: those asked for, those that the folder holds, or all."""
        if self.sequences or self.folder is None:
            return self.sequences or NAMES
        return tuple(name for name in NAMES if (self.folder / name).is_dir()) or NAMES

    def _options(self, name: str) -> dict[str, Any]:
        """What a sequence is made with, as its folder says where there is one."""
        folder = None if self.folder is None else self.folder / name
        made = _OPTIONS if folder is None else made_with(folder)
        for key, value in made.items():
            asked = getattr(self, key)
            if folder is not None and asked not in (None, value):
                words = key.replace("_", " ")
                raise InputError(f"{folder} was made with another {words}: {value}, not {asked}")
        asked_for = {key: getattr(self, key) for key in made if getattr(self, key) is not None}
        return {**made, **asked_for, "folder": None if folder is None else str(folder)}

    @staticmethod
    def run(spec: UsmeSpec) -> dict[str, Any]:
        """Track the sequence from its true first pose and measure."""
        limit_threads(1)
        return run_usme(spec)

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """The sequences that were run, then a table for each family of measures."""
        names = {row["spec"]["sequence"] for row in rows}
        entries = [
            {
                "sequence": entry.name,
                "scene": entry.scene,
                "loops": entry.loops,
                "perturbations": ", ".join(t.replace(",", " ") for t in entry.perturbations)
                or None,
                "about": entry.about,
            }
            for entry in SUITE
            if entry.name in names
        ]
        tables = [make_table(list(entries[0]), entries, "Sequences")]
        for title, family in TABLES.items():
            keys = measured(family, rows)
            lines = [
                {
                    **{name: row["spec"][name] for name in ("sequence", "backend")},
                    **{key: row["result"].get(key) for key in keys},
                }
                for row in finished(rows)
                if title != "Loops" or "loop_recall" in row["result"]
            ]
            tables.append(make_table(("sequence", "backend", *keys), lines, title))
        return tables

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Errors and losses of every backend on every sequence, and the paths beside the truth."""
        return [_errors(rows), _paths(rows)]


def _errors(rows: Sequence[Row]) -> Chart:
    backends = dict.fromkeys(row["spec"]["backend"] for row in finished(rows))
    panels = []
    for key in ("ate_m", "lost_share"):
        series = []
        for backend in backends:
            own = [row for row in finished(rows) if row["spec"]["backend"] == backend]
            values = [row["result"][key] for row in own]
            names = [row["spec"]["sequence"] for row in own]
            series.append(Series(backend, values, names, mode="markers"))
        panels.append(Panel(key, "", series, "x" if key == "ate_m" else ""))
    return Chart("usme", "Error and losses", "One mark a run.", panels)


def _paths(rows: Sequence[Row]) -> Chart:
    """USME's figure 8: every sequence from above."""
    panels = []
    for sequence in dict.fromkeys(row["spec"]["sequence"] for row in finished(rows)):
        own = [row for row in finished(rows) if row["spec"]["sequence"] == sequence]
        drawn = [(row["spec"]["backend"], row["result"], "path", "lines") for row in own]
        drawn.append(("truth", own[0]["result"], "true", "dashes"))
        lines = [
            Series(name, result[f"{path}_x_m"], result[f"{path}_y_m"], mode=mode)
            for name, result, path, mode in drawn
        ]
        panels.append(Panel("position_x_m", "position_y_m", lines, title=sequence, equal=True))
    return Chart("paths", "Paths", "From above; not aligned, all start at the truth.", panels)


def check_suite(sequences: Sequence[str], image_size: str) -> None:
    """Refuse unknown sequences and sizes.

    Raises:
        InputError: naming the valid choices.
    """
    if not sequences:
        raise InputError("Usme.sequences is empty")
    for name in sequences:
        find(name)
    rendered_size(image_size)
