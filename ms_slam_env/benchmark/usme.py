"""The USME suite: render its sequences into folders, run SLAM backends over them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ms_slam_env import __version__, scenes, slam
from ms_slam_env.benchmark import usme_suite
from ms_slam_env.benchmark.usme_report import label, save_figure, tables
from ms_slam_env.benchmark.usme_run import UsmeSpec, run_apart
from ms_slam_env.camera import XTION_SIZES
from ms_slam_env.config import check_range, parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.scenes import Scene
from ms_slam_env.sequences.writing import DESCRIPTION, write_sequence

NAMES = tuple(entry.name for entry in usme_suite.SUITE)


@dataclass(frozen=True)
class UsmeOptions:
    """What of the suite, and how.

    Attributes:
        sequences: their names.
        image_size: such as 160x120.
        seed: of scenes, ways, noise and perturbations.
        frames_scale: share of the frames that the same ways take: 0.5 halves the work and
            doubles the camera's speed.

    Raises:
        InputError: an unknown sequence or size, or a number out of range.
    """

    sequences: tuple[str, ...] = NAMES
    image_size: str = "160x120"
    seed: int = 2000
    frames_scale: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be rendered."""
        if not self.sequences:
            raise InputError("UsmeOptions.sequences is empty")
        for name in self.sequences:
            usme_suite.find(name)
        if self.image_size not in XTION_SIZES:
            raise unknown("image size", self.image_size, XTION_SIZES)
        check_range(self, "seed", 0, 2**32 - 1)
        check_range(self, "frames_scale", 0.002, 10.0)


def description(options: UsmeOptions, entry: usme_suite.UsmeSequence) -> dict[str, Any]:
    """What makes a sequence, for its folder."""
    return {
        "version": __version__,
        "suite": "usme",
        "sequence": asdict(entry),
        "image_size": options.image_size,
        "seed": options.seed,
        "frames_scale": options.frames_scale,
    }


def make_suite(options: UsmeOptions, out: Path, with_truth: bool = False) -> list[Path]:
    """Write every sequence into a folder of ``out``; go on where an interrupted call stopped.

    Raises:
        InputError: a folder that holds something else.
    """
    made: dict[str, Scene] = {}
    folders = []
    for name in options.sequences:
        entry = usme_suite.find(name)
        if entry.scene not in made:
            made = {entry.scene: scenes.make(entry.scene, options.seed)}  # one is large enough
        sequence = usme_suite.render(
            entry, made[entry.scene], options.image_size, options.frames_scale
        )
        write_sequence(sequence, out / name, description(options, entry), with_truth)
        folders.append(out / name)
    return folders


def run_suite(
    options: UsmeOptions,
    backends: tuple[str, ...],
    out: Path,
    folder: Path | None = None,
    workers: int = 1,
) -> tuple[str, list[str]]:
    """Run every backend over every sequence; write ``usme.json``, ``table.md`` and ``usme.png``.

    Runs that an earlier call left in ``out`` are not repeated.

    Args:
        options: of the suite.
        backends: ``NAME`` or ``NAME,parameter=value,...``.
        out: folder of the results.
        folder: of the sequences that ``make_suite`` wrote with the same options; None renders every
            frame when it is needed.
        workers: runs at the same time; more than one disturbs the clock.

    Returns:
        the tables as Markdown, and what failed, one line each.

    Raises:
        InputError: an unknown backend or parameter, or a folder that lacks a sequence or holds
            another.
        RuntimeError: every run failed.
    """
    named = [parse_named(text, "backend") for text in backends]
    for name, params in named:
        slam.check_parameters(name, params)
    if folder is not None:
        for name in options.sequences:
            _check_folder(folder / name, options)
    specs = [
        UsmeSpec(
            sequence=sequence,
            backend=name,
            image_size=options.image_size,
            seed=options.seed,
            params=params,
            frames_scale=options.frames_scale,
            folder=None if folder is None else str(folder / sequence),
        )
        for sequence in options.sequences
        for name, params in named
    ]
    rows = run_all(specs, run_apart, out, workers, "runs")
    check_any_finished(rows)
    return write_results(options, backends, rows, out), failures(rows)


def write_results(
    options: UsmeOptions, backends: tuple[str, ...], rows: list[Row], out: Path
) -> str:
    """Write ``usme.json``, ``table.md`` and ``usme.png``; return the tables as Markdown."""
    out.mkdir(parents=True, exist_ok=True)
    content = {
        "provenance": provenance(),
        "config": {**asdict(options), "backends": backends},
        "summary": [
            {
                "sequence": row["spec"]["sequence"],
                "backend": label(row["spec"]),
                "error": row["error"],
                **(row["result"] or {}),
            }
            for row in rows
        ],
        "runs": rows,
    }
    write_json(out / "usme.json", content)
    text = tables(rows)
    (out / "table.md").write_text(text, encoding="utf-8")
    save_figure(rows, out / "usme.png")
    return text


def _check_folder(folder: Path, options: UsmeOptions) -> None:
    """Refuse a folder that is not the sequence of these options."""
    wanted = json.loads(json.dumps(description(options, usme_suite.find(folder.name))))
    file = folder / DESCRIPTION
    if not file.is_file():
        raise InputError(f"{folder} holds no finished sequence; ms-slam usme make writes it")
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"cannot read {file}: {error}") from None
    for name, value in wanted.items():
        if found.get(name) != value:
            raise InputError(
                f"{folder} was made with another {name.replace('_', ' ')}, see its {DESCRIPTION}"
            )
