"""Processor time of a frame of the surfel SLAM, by stage, image size and stored surfels.

``ms-slam experiment slam-speed --out DIR`` writes ``slam_speed.json``,
``slam_speed.md`` and ``slam_speed.png``. With ``--against CHECKOUT`` the package of another
checkout runs in turns with this one, and the table shows the ratio.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ms_slam_env import scenes
from ms_slam_env.benchmark import slam_speed_child
from ms_slam_env.benchmark.slam_speed_report import markdown_report, save_figure, summarise
from ms_slam_env.camera import xtion
from ms_slam_env.command_line import exit_code, parse
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.sequences import handheld_trajectory, render_sequence

PROGRAM = "ms-slam experiment slam-speed"
NEW, OLD = "this", "other"
_START = "import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], None, '__main__')"


@dataclass(frozen=True)
class SlamSpeedConfig:
    """Processor time of a frame of the surfel SLAM, by stage, image size and stored surfels.

    Every measurement is a process of its own on one core; rounds of all of them follow each other,
    so that a busy machine disturbs all alike.
    """

    out: Path = Path("results/slam_speed")
    """Folder of the results."""
    scene: str = "living_room"
    """Where the sequence is rendered."""
    seed: int = 2000
    """Of scene, trajectory and noise."""
    sizes: tuple[str, ...] = ("160x120", "320x240")
    """Image sizes."""
    stored: tuple[int, ...] = (10_000, 100_000, 300_000, 1_000_000)
    """Surfels in the map; those beyond what the sequence makes lie in far places."""
    frames: int = 80
    """Length of the sequence."""
    warm_up: int = 20
    """Frames before the measurement, which fill the map and load the kernels."""
    repeats: int = 3
    """Rounds; times are medians over them."""
    against: Path | None = None
    """Checkout with another version of the package to compare with."""
    backend: tuple[str, ...] = ()
    """Parameters of the SLAM that differ from the default, ``name=value`` each (JSON values)."""

    def __post_init__(self) -> None:
        """Refuse values out of range.

        Raises:
            InputError: a value out of range, or a checkout without the package.
        """
        check_range(self, "frames", 2, 100_000)
        check_range(self, "warm_up", 1, self.frames - 1)
        check_range(self, "repeats", 1, 1000)
        if not self.stored or not all(1 <= count <= 40_000_000 for count in self.stored):
            raise InputError(f"stored = {self.stored} must hold integers in [1, 40000000]")
        if self.against is not None and not (self.against / "ms_slam_env").is_dir():
            raise InputError(f"{self.against} holds no package ms_slam_env")


@dataclass
class SpeedReport:
    """Everything that was measured; ``rows`` are raw, ``summary`` is over the repeats."""

    provenance: dict[str, Any]
    config: dict[str, Any]
    rows: list[dict[str, Any]] = field(default_factory=list)
    summary: list[dict[str, Any]] = field(default_factory=list)


def backend_parameters(words: tuple[str, ...]) -> dict[str, Any]:
    """Parameters of ``name=value`` words.

    Raises:
        InputError: a word of another form, or a value that is no JSON.
    """
    parameters = {}
    for word in words:
        name, equals, value = word.partition("=")
        try:
            parameters[name] = json.loads(value)
        except json.JSONDecodeError:
            equals = ""
        if not equals:
            raise InputError(f"a parameter is given as name=value, such as coverage_px=0.9: {word}")
    return parameters


def store_sequence(config: SlamSpeedConfig, size: str) -> Path:
    """Render the noisy sequence of one size into the folder of the results, if it is not there."""
    name = f"{config.scene}_{config.seed}_{size}_{config.frames}.npz"
    path = config.out / "sequences" / name
    if not path.exists():
        scene = scenes.make(config.scene, config.seed)
        poses = handheld_trajectory(scene, config.frames, config.seed, 0.015, 1.0)
        sequence = render_sequence(scene, poses, xtion(size), "kinect", config.seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            path,
            color=np.stack([frame.color for frame in sequence.frames]),
            depth=np.stack([frame.depth for frame in sequence.frames]),
            poses=np.stack(list(sequence.poses)),
        )
    return path


def run_child(arguments: dict[str, Any], checkout: Path | None) -> list[dict[str, Any]]:
    """Measure in a process on one core, with the package of ``checkout`` (None: this one's).

    Raises:
        RuntimeError: the process failed.
    """
    environment = dict(os.environ)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        environment[variable] = "1"
    root = checkout or Path(__file__).resolve().parents[2]
    root = root.resolve()
    environment["PYTHONPATH"] = str(root)
    # Not as a script: its folder, first on the path then, would hide modules of Python.
    words = [sys.executable, "-c", _START, str(slam_speed_child.__file__), json.dumps(arguments)]
    # In the checkout: the current folder comes before PYTHONPATH.
    done = subprocess.run(words, env=environment, cwd=root, capture_output=True, text=True)
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["no message"]
        raise RuntimeError(f"the measurement in {root} failed: {lines[-1]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def run(config: SlamSpeedConfig) -> SpeedReport:
    """Measure every size with every version, in turns, and write the report.

    Raises:
        InputError: unknown scene, size or parameter.
    """
    start = time.perf_counter()
    report = SpeedReport(provenance(), {key: str(v) for key, v in asdict(config).items()})
    versions: dict[str, Path | None] = {NEW: None}
    if config.against is not None:
        versions[OLD] = config.against
    shared = {"warm_up": config.warm_up, "stored": list(config.stored)}
    shared["backend"] = backend_parameters(config.backend)
    paths = {size: str(store_sequence(config, size).resolve()) for size in config.sizes}
    rounds = [(repeat, size) for repeat in range(config.repeats) for size in config.sizes]
    for repeat, size in tqdm(rounds, desc="measurements", file=sys.stderr):
        for version, checkout in versions.items():
            rows = run_child({**shared, "size": size, "sequence": paths[size]}, checkout)
            extra = {"version": version, "size": size, "repeat": repeat}
            report.rows.extend({**extra, **row} for row in rows)
    report.provenance["seconds"] = round(time.perf_counter() - start, 1)
    report.summary = summarise(report.rows)
    config.out.mkdir(parents=True, exist_ok=True)
    write_json(config.out / "slam_speed.json", asdict(report))
    text = markdown_report(report.summary)
    (config.out / "slam_speed.md").write_text(text, encoding="utf-8")
    save_figure(report.summary, config.out / "slam_speed.png")
    return report


def main(arguments: list[str] | None = None) -> int:
    """Run the measurement and print its table; return the exit code."""
    config = parse(SlamSpeedConfig, arguments, PROGRAM)
    run(config)
    print((config.out / "slam_speed.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
