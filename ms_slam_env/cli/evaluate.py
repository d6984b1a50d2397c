"""``ms-slam evaluate``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ms_slam_env.command_line import parse
from ms_slam_env.errors import InputError


@dataclass(frozen=True)
class Arguments:
    """Compare an estimated trajectory, a map, or both with the truth.

    Trajectories are TUM files: timestamp tx ty tz qx qy qz qw, camera to world. Maps are PLY files
    (or what else trimesh reads): clouds as they are, meshes sampled. With --out, writes
    evaluation.json, table.md, trajectory.png and map.png, and the poses that correspond, aligned,
    as evaluation.estimate.txt and evaluation.truth.txt.
    """

    estimate: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="ESTIMATE")] = None
    """Estimated trajectory."""
    groundtruth: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="GROUNDTRUTH")
    ] = None
    """True trajectory."""
    align: str = "se3"
    """Alignment for ATE: se3, sim3 (relative errors are then of the scaled estimate) or none."""
    delta: float = 1
    """How far apart the poses of a relative error are."""
    delta_unit: str = "frames"
    """Unit of --delta: frames, m (along the true path) or s."""
    pairs: str = "all"
    """Pairs of poses for relative errors: all, or consecutive (each begins where one ends)."""
    tolerance: float = 0.1
    """Of a delta in m or s over all pairs, as a share of it."""
    segments: int = 1
    """Errors are also given for so many equal pieces of the trajectory."""
    segment_lengths_m: tuple[float, ...] = ()
    """Lengths of sub-trajectories for drift, as in KITTI; by default a tenth to a half of the
    path."""
    max_difference_s: float = 0.02
    """Largest difference between timestamps that correspond."""
    gap_s: float | None = None
    """An estimate without poses for longer was lost in between; by default three times the median
    interval."""
    frames: Path | None = None
    """frames.csv of ms-slam run: leave out the poses of frames that were not tracked."""
    map: Path | None = None
    """Estimated map."""
    true_map: Path | None = None
    """True surface; or a sequence's folder, for what its depth shows from its true poses."""
    register: str = "none"
    """Bring the map onto the true one first: none, icp, plane-icp or gicp."""
    cutoff_m: float = 0.5
    """Pairs of points farther apart do not count in that."""
    thresholds_m: tuple[float, ...] = (0.02, 0.05)
    """For precision, recall and F-score of the map."""
    voxel_m: float = 0.01
    """Maps keep one point a voxel of this side; 0 keeps all."""
    samples: int = 200_000
    """Points taken from a mesh."""
    remove_outliers: bool = False
    """Statistically, from the estimated map, before it is compared."""
    neighbours: int = 20
    """Of a point in the statistics of outliers."""
    std_ratio: float = 2.0
    """Standard deviations above the mean that make an outlier."""
    out: Path | None = None
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Print what was measured, and write it."""
    args = parse(Arguments, arguments, "ms-slam evaluate")
    if (args.estimate is None) != (args.groundtruth is None):
        raise InputError("Missing GROUNDTRUTH: trajectories are given as ESTIMATE GROUNDTRUTH")
    if (args.map is None) != (args.true_map is None):
        raise InputError("Missing file: maps are given as --map ESTIMATE --true-map GROUNDTRUTH")
    if args.estimate is None and args.map is None:
        raise InputError(
            "Missing files: ESTIMATE GROUNDTRUTH, or --map ESTIMATE --true-map GROUNDTRUTH"
        )
    from ms_slam_env.report.provenance import provenance
    from ms_slam_env.report.records import write_json

    result: dict[str, Any] = {}
    parts: list[str] = []
    # Nothing is written before everything has been measured: bad input leaves no half of a result.
    writers = []
    if args.estimate is not None:
        writers.append(_trajectories(args, result, parts))
    if args.map is not None:
        writers.append(_maps(args, result, parts))
    if args.out is not None:
        for write in writers:
            write(args.out)
        write_json(args.out / "evaluation.json", {**result, "provenance": provenance()})
        (args.out / "table.md").write_text("\n".join(parts), encoding="utf-8")
    return 0


def _trajectories(
    args: Arguments, result: dict[str, Any], parts: list[str]
) -> Callable[[Path], object]:
    """Measure and print; return what writes figure and poses into a folder."""
    from ms_slam_env.benchmark import trajectory_evaluation_report as report
    from ms_slam_env.benchmark.trajectory_evaluation import (
        TrajectoryOptions,
        match_files,
        measure_matched,
    )
    from ms_slam_env.sequences import write_trajectory

    assert args.estimate is not None
    assert args.groundtruth is not None
    options = TrajectoryOptions(
        align=args.align,
        delta=args.delta,
        delta_unit=args.delta_unit,
        pairs=args.pairs,
        tolerance=args.tolerance,
        segments=args.segments,
        segment_lengths_m=args.segment_lengths_m or None,
        max_difference_s=args.max_difference_s,
        gap_s=args.gap_s,
        frames=None if args.frames is None else str(args.frames),
    )
    matched = match_files(args.estimate, args.groundtruth, options)
    result.update(measure_matched(args.estimate, args.groundtruth, matched, options))
    parts.append(report.tables(result))
    print(report.summary(result))

    def write(out: Path) -> None:
        report.save_figure(matched, out / "trajectory.png")
        for name, poses in (("estimate", matched.estimate), ("truth", matched.truth)):
            # A name of its own: the folder may be that of the files that are compared.
            write_trajectory(out / f"evaluation.{name}.txt", matched.times, poses)

    return write


def _maps(args: Arguments, result: dict[str, Any], parts: list[str]) -> Callable[[Path], object]:
    """Measure and print; return what writes the figure into a folder."""
    from ms_slam_env.benchmark import map_evaluation_report as report
    from ms_slam_env.benchmark.map_evaluation import MapOptions, evaluate_maps

    assert args.map is not None
    assert args.true_map is not None
    options = MapOptions(
        register=args.register,
        cutoff_m=args.cutoff_m,
        remove_outliers=args.remove_outliers,
        neighbours=args.neighbours,
        std_ratio=args.std_ratio,
        thresholds_m=args.thresholds_m,
        voxel_m=args.voxel_m,
        samples=args.samples,
    )
    found, compared = evaluate_maps(args.map, args.true_map, options)
    result.update(found)
    parts.append(report.tables(found))
    print(report.summary(found))
    return lambda out: report.save_figure(compared, out / "map.png")
