"""Measure the surfel SLAM's processor time per frame, by stage, image size and stored surfels."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from ms_slam_experiments.shared import slam_speed_child

from ms_slam_env import scenes, sequences, slam
from ms_slam_env._runtime.threads import thread_environment
from ms_slam_env.benchmark.experiment import Experiment, check_names
from ms_slam_env.camera import xtion
from ms_slam_env.config import Checked, bounded, check_range, parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table

THIS, OTHER = "this", "other"
REST = "rest"
_START = "import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], None, '__main__')"


@dataclass(frozen=True)
class SpeedSpec:
    """One process of round ``repeat``, with this checkout's package or another's (``version``)."""

    version: str
    size: str
    repeat: int
    scene: str
    seed: int
    stored: tuple[int, ...]
    frames: int
    warm_up: int
    backend: tuple[str, ...]
    checkout: str = ""


@dataclass(frozen=True)
class SlamSpeed(Experiment, Checked):
    """Processor time of a frame of the surfel SLAM

    Measured by stage, image size and number of stored surfels; surfels beyond those of the sequence
    lie in far places. Every measurement is a separate process on one core. All measurements repeat
    in rounds, so that a busy machine affects them equally.
    """

    scene: str = "living_room"
    """Scene in which to render the sequence."""
    seed: int = 2000
    """Seed of scene, trajectory and noise."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    stored: tuple[int, ...] = (10_000, 100_000, 300_000, 1_000_000)
    """Numbers of surfels in the map; those beyond the sequence's own lie in far places."""
    frames: int = bounded(80, 2, 100_000)
    """Number of frames of the sequence."""
    warm_up: int = 20
    """Frames before the measurement, which fill the map and load the kernels."""
    repeats: int = bounded(3, 1, 1000)
    """Number of rounds; times are medians over them."""
    against: Path | None = None
    """Checkout with another version of the package, which runs alternately with this one."""
    backend: tuple[str, ...] = ()
    """Parameters of SLAM that differ from the default, ``name=value`` each."""

    unit = "measurements"
    workers = 1

    def __post_init__(self) -> None:
        """Refuse values out of range, or a checkout without the package."""
        super().__post_init__()
        check_range(self, "warm_up", 1, self.frames - 1)
        if not self.stored or not all(1 <= count <= 40_000_000 for count in self.stored):
            raise InputError(f"stored = {self.stored} must hold integers in [1, 40000000]")
        if self.against is not None and not (self.against / "ms_slam_env").is_dir():
            raise InputError(f"{self.against} holds no package ms_slam_env")

    def specs(self) -> list[SpeedSpec]:
        """Every round, size and version, alternating."""
        backend_parameters(self.backend)
        checkouts = {THIS: ""}
        if self.against is not None:
            checkouts[OTHER] = str(self.against)
        versions = [{"version": name, "checkout": path} for name, path in checkouts.items()]
        turns = itertools.product(range(self.repeats), self.sizes, versions)
        check_names(self)
        return [
            self.spec(SpeedSpec, repeat=repeat, size=size, **version)
            for repeat, size, version in turns
        ]

    @staticmethod
    def run(spec: SpeedSpec) -> dict[str, Any]:
        """One process: a measurement for each number of stored surfels."""
        _, path = stored_sequence(spec.scene, spec.seed, spec.frames, spec.size)
        arguments = {
            "sequence": path,
            "size": spec.size,
            "stored": list(spec.stored),
            "warm_up": spec.warm_up,
            "backend": backend_parameters(spec.backend),
        }
        found = run_child(arguments, Path(spec.checkout) if spec.checkout else None)
        return {"runs": [_figures(one) for one in found]}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line for each size, number of stored surfels and version."""
        columns: list[Column | str] = ["image_size", "surfels_stored"]
        if self.against is not None:
            columns += ["version", "cpu_ratio", "same_poses"]
        columns += ["cpu_ms_median", "cpu_ms_mean"]
        columns += [Column(name, "stage_cpu_ms", name) for name in (*slam_speed_child.STAGES, REST)]
        note = "Medians over the rounds; the stages are means over the frames."
        return [make_table([*columns, "lost_frames"], summarise(rows), note=note)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """The cost against stored surfels, and by stage with the smallest map."""
        lines = summarise(rows)
        names = dict.fromkeys((line["image_size"], line["version"]) for line in lines)
        over, bars = [], []
        for name in names:
            own = [line for line in lines if (line["image_size"], line["version"]) == name]
            label = name[0] if name[1] == THIS else f"{name[0]}, other version"
            x, y = ([line[key] for line in own] for key in ("surfels_stored", "cpu_ms_mean"))
            over.append(Series(label, x, y))
            stages = [*slam_speed_child.STAGES, REST]
            bars.append(Series(label, stages, [own[0][stage] for stage in stages], mode="bars"))
        panels = [
            Panel("surfels_stored", "cpu_ms_mean", over, "x"),
            Panel("", "stage_cpu_ms", bars, title="smallest map"),
        ]
        caption = "Mean processor time of a frame on one core."
        return [Chart("slam_speed", "Cost of a frame", caption, panels)]


def _figures(one: Mapping[str, Any]) -> dict[str, Any]:
    """Summary of a measurement by the child process, which returns single frames."""
    mean = float(np.mean(one["frame_ms"]))
    stages = {stage: float(np.mean(ms)) for stage, ms in one["stages_ms"].items()}
    stages[REST] = mean - sum(stages.values())
    return {
        "target_surfels": one["target"],
        "surfels_stored": one["surfels"],
        "cpu_ms_mean": mean,
        "cpu_ms_median": float(np.median(one["frame_ms"])),
        "stages": [{"stage": name, "stage_cpu_ms": ms} for name, ms in stages.items()],
        "lost_frames": one["lost_frames"],
        "poses_sha256": one["estimates"],
    }


def summarise(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """A line for each (size, stored surfels, version): medians over the rounds.

    ``cpu_ratio`` is the mean time per frame of this version divided by the other's, median over
    the rounds; ``same_poses`` says whether both found the same poses, bit for bit. Both are None
    without another version.
    """
    groups: dict[tuple[str, int, str], list[dict[str, Any]]] = {}
    for row in finished(rows):
        for run in row["result"]["runs"]:
            stages = {one["stage"]: one["stage_cpu_ms"] for one in run["stages"]}
            key = (row["spec"]["size"], run["target_surfels"], row["spec"]["version"])
            groups.setdefault(key, []).append({**run, **stages})
    lines = []
    for (size, target, version), group in groups.items():
        other = groups.get((size, target, OTHER), []) if version == THIS else []
        ratios = [a["cpu_ms_mean"] / b["cpu_ms_mean"] for a, b in zip(group, other, strict=False)]
        times = ("cpu_ms_median", "cpu_ms_mean", *slam_speed_child.STAGES, REST)
        line: dict[str, Any] = {
            "image_size": size,
            "version": version,
            **{key: float(np.median([run[key] for run in group])) for key in times},
            **{key: group[0][key] for key in ("surfels_stored", "lost_frames")},
            "cpu_ratio": float(np.median(ratios)) if ratios else None,
            "same_poses": group[0]["poses_sha256"] == other[0]["poses_sha256"] if other else None,
        }
        lines.append((_pixels(size), target, version, line))
    return [line for *_, line in sorted(lines, key=lambda entry: entry[:3])]


def _pixels(size: str) -> int:
    return int(np.prod(xtion(size).shape))


def backend_parameters(words: tuple[str, ...]) -> dict[str, Any]:
    """Parameters of the surfel SLAM from ``name=value`` words, as ``parse_named`` reads them.

    Raises:
        InputError: a malformed word, an unknown parameter, or a value that is out of range.
    """
    name, parameters = parse_named(",".join(("surfel", *words)), "backend")
    slam.check_parameters(name, parameters)
    return parameters


@cache
def stored_sequence(scene_name: str, seed: int, frames: int, size: str) -> tuple[Any, str]:
    """Write a noisy sequence to a temporary file of this process; return its folder and path."""
    scene = scenes.make(scene_name, seed)
    poses = sequences.handheld_trajectory(scene, frames, seed, 0.015, 1.0)
    sequence = sequences.render_sequence(scene, poses, xtion(size), "kinect", seed)
    shown = list(sequence.frames)
    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / "sequence.npz"
    color, depth = (np.stack([getattr(f, name) for f in shown]) for name in ("color", "depth"))
    np.savez(path, color=color, depth=depth, poses=np.stack(list(sequence.poses)))
    return folder, str(path)


def run_child(arguments: dict[str, Any], checkout: Path | None) -> list[dict[str, Any]]:
    """Measure in a process on one core, with the package of ``checkout`` (None: this one's).

    Raises:
        RuntimeError: the process failed.
    """
    root = (checkout or Path(__file__).parents[1]).resolve()
    environment = os.environ | thread_environment(1) | {"PYTHONPATH": str(root)}
    # Not run as a script, because its folder, first on the path, would hide Python modules. Run in
    # the checkout, because the current folder comes before PYTHONPATH.
    words = [sys.executable, "-c", _START, str(slam_speed_child.__file__), json.dumps(arguments)]
    done = subprocess.run(words, env=environment, cwd=root, capture_output=True, text=True)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise RuntimeError(f"the measurement in {root} failed: {lines[-1]}")
    return list(json.loads(done.stdout.strip().splitlines()[-1]))
