"""Dataset difficulty: Table I of the paper, for recorded depth and for motions in our scenes.

Saeedi et al., ICRA 2017, section V-C: the harder a sequence, the larger the statistics of its
divergence. Its authors find lr kt2 and lr kt3 of ICL-NUIM harder than lr kt0 and lr kt1. Here the
same four camera motions are rendered in other scenes, all four as one rigid whole, so that they
keep their places relative to each other as they have them in the ICL-NUIM living room, and at one
common scale; at several places, because what a camera sees differs from place to place. Run as
``python -m ms_slam_env.benchmark.difficulty --data DIR --out DIR``; no image is stored.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark import difficulty_report as report
from ms_slam_env.benchmark.difficulty_report import RECORDING
from ms_slam_env.benchmark.image_motion import MOTIONS, contrast, frame_motion
from ms_slam_env.camera import XTION_SIZES, Intrinsics, RGBDFrame
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.config import check_range
from ms_slam_env.divergence import DivergenceConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import write_json
from ms_slam_env.sensor.noise import noise_config
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import place_trajectory, read_trajectory, render_sequence
from ms_slam_env.sequences.recording import open_recording

Float64 = NDArray[np.float64]

PROGRAM = "python -m ms_slam_env.benchmark.difficulty"
SETTINGS = {"paper": DivergenceConfig.paper(), "default": DivergenceConfig()}
ICL_NUIM = Intrinsics(fx=481.2, fy=480.0, cx=319.5, cy=239.5, width=640, height=480)
_TRAJECTORY = "icl_nuim/trajectories/{}.tum.txt"
_DEPTH = "icl_nuim/lr_kt3_depth"


@dataclass(frozen=True)
class DifficultySpec:
    """A motion in a scene, or a recording.

    Attributes:
        scene: name, mesh file, or ``RECORDING``.
        motion: such as ``lr_kt0``.
        motions: all that are placed together.
        data: folder of the trajectories and recordings.
        placement: seed of the place.
        scale: factor on all motions.
        image_size: of the rendered images; recorded ones are at most as large.
        noise: of the rendered images.
        every: take every n-th frame.
    """

    scene: str
    motion: str
    motions: tuple[str, ...]
    data: str
    placement: int
    scale: float
    image_size: str
    noise: str
    every: int


@dataclass(frozen=True)
class Arguments:
    """Difficulty of lr_kt3's recorded depth and of the four lr motions in our scenes."""

    data: Path = Path("../shared/data")
    """Folder that holds icl_nuim/trajectories/lr_kt0.tum.txt and so on, and lr_kt3_depth."""
    scenes: tuple[str, ...] = ("living_room", "../shared/data/small_house.glb")
    """Names of scenes, or mesh files."""
    motions: tuple[str, ...] = ("lr_kt0", "lr_kt1", "lr_kt2", "lr_kt3")
    """Files of the trajectories, without .tum.txt."""
    placements: int = 3
    """Places of the motions in each scene."""
    image_size: str = "320x240"
    """Of the rendered images, with the field of view of ICL-NUIM's camera."""
    noise: tuple[str, ...] = ("none",)
    """Noise of the rendered images: none, kinect, or both."""
    every: int = 1
    """Take every n-th frame."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/difficulty")
    """Folder of the results."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "placements", 1, 1000)
        check_range(self, "every", 1, 1000)
        if self.image_size not in XTION_SIZES:
            raise unknown("image size", self.image_size, XTION_SIZES)
        for name in self.noise:
            noise_config(name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write and print the tables; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    rows = run_all(specs_of(args), measure, args.out, args.workers, "motions")
    check_any_finished(rows)
    finished = [row for row in rows if row["error"] is None]
    found = {
        "statistics": report.statistics(finished),
        "order": report.order(finished),
        "correlation": report.correlations(finished),
    }
    write_json(
        args.out / "difficulty.json",
        {
            "provenance": provenance(),
            "config": asdict(args) | {"data": str(args.data), "out": str(args.out)},
            "settings": {name: asdict(config) for name, config in SETTINGS.items()},
            **found,
        },
    )
    text = report.as_markdown(**found)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    report.save_figures(finished, args.out)
    print(text)
    return report_failures(failures(rows), PROGRAM)


def specs_of(args: Arguments) -> list[DifficultySpec]:
    """Every motion at every place, and the recording.

    The scale is the largest at which all motions together fit at every place of every scene.

    Raises:
        InputError: a scene, trajectory or recording that cannot be read, or no place.
    """
    motions = _concatenated(str(args.data), args.motions)[1]
    scale = min(
        place_trajectory(get_scene(scene, 0), motions, seed).scale
        for scene in args.scenes
        for seed in range(args.placements)
    )
    data, size, every = str(args.data), args.image_size, args.every
    recorded = DifficultySpec(RECORDING, "lr_kt3", (), data, 0, 1.0, size, "none", every)
    return [
        recorded,
        *(
            DifficultySpec(scene, motion, args.motions, data, seed, scale, size, noise, every)
            for noise in args.noise
            for scene in args.scenes
            for seed in range(args.placements)
            for motion in args.motions
        ),
    ]


@lru_cache(maxsize=1)
def _concatenated(data: str, motions: tuple[str, ...]) -> tuple[list[Float64], Float64]:
    """Times (N_i,) of each motion, and the poses (sum N_i, 4, 4) of all of them."""
    if not motions:
        raise InputError("no motion given")
    pairs = [read_trajectory(Path(data) / _TRAJECTORY.format(name)) for name in motions]
    return [times for times, _ in pairs], np.concatenate([poses for _, poses in pairs])


def measure(spec: DifficultySpec) -> dict[str, Any]:
    """Divergences and motions of one sequence.

    Returns:
        ``times_s`` and ``gaps_s`` (T,); by name of the setting (T, 2) intensity and depth
        divergence, nats; by name of the quantity in ``MOTIONS`` (T,); and ``contrast`` and
        ``depth_m``, the means over the frames of the grey values' standard deviation and of the
        depth.
    """
    frames, times, poses, intrinsics = _open(spec)
    motion, shades, depths = [], [], []

    def watched() -> Iterator[RGBDFrame]:
        for index, frame in enumerate(frames):
            shades.append(contrast(frame))
            depths.append(float(frame.depth[frame.depth > 0].mean()) if frame.depth.any() else 0.0)
            if index + 1 < len(poses):
                gap_s = float(times[index + 1] - times[index])
                pair = poses[index], poses[index + 1]
                motion.append(frame_motion(frame, *pair, intrinsics, gap_s))
            yield frame

    values = consecutive_divergences(watched(), intrinsics, list(SETTINGS.values()))
    if spec.scene == RECORDING:
        values[:, :, 0] = np.nan  # it has no colour
    return {
        "times_s": (times[1:] - times[0]).tolist(),
        "gaps_s": np.diff(times).tolist(),
        "divergences": {name: values[:, k].tolist() for k, name in enumerate(SETTINGS)},
        "motion": dict(zip(MOTIONS, np.array(motion).T.tolist(), strict=True)),
        "contrast": float(np.mean(shades)),
        "depth_m": float(np.mean(depths)),
    }


def _open(spec: DifficultySpec) -> tuple[Iterator[RGBDFrame], Float64, Float64, Intrinsics]:
    """Frames, their times (N,) and poses (N, 4, 4), and intrinsics."""
    picked = slice(None, None, spec.every)
    if spec.scene == RECORDING:
        recording = open_recording(Path(spec.data) / _DEPTH).every(spec.every)
        if XTION_SIZES[spec.image_size][0] < recording.source.width:
            recording = recording.at_size(spec.image_size)
        times, poses = read_trajectory(Path(spec.data) / _TRAJECTORY.format(spec.motion))
        nearest = np.abs(times[:, None] - recording.timestamps).argmin(axis=0)
        return iter(recording), recording.timestamps, poses[nearest], recording.intrinsics
    all_times, together = _concatenated(spec.data, spec.motions)
    scene = get_scene(spec.scene, 0)
    placed = place_trajectory(scene, together, spec.placement, spec.scale).poses
    number = spec.motions.index(spec.motion)
    first = sum(len(times) for times in all_times[:number])
    times = all_times[number][picked]
    poses = placed[first : first + len(all_times[number])][picked]
    K = ICL_NUIM.scaled(XTION_SIZES[spec.image_size][0] / ICL_NUIM.width)
    sequence = render_sequence(scene, poses, K, spec.noise, spec.placement, timestamps=times)
    return iter(sequence.frames), times, poses, K


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
