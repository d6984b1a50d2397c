"""``ms-slam evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ms_slam_env._runtime.command_line import parse
from ms_slam_env.errors import InputError

if TYPE_CHECKING:
    from ms_slam_env.evaluation.map_files import MapOptions
    from ms_slam_env.evaluation.trajectory_files import TrajectoryOptions


@dataclass(frozen=True)
class Arguments:
    """Compare an estimated trajectory, a map, or both with the truth.

    Trajectories are TUM files: timestamp tx ty tz qx qy qz qw, camera to world. Maps are PLY files
    (or OBJ, glTF, STL, OFF): clouds as they are, meshes sampled. With --out, writes
    evaluation.json, table.md and figures, and the poses that correspond, aligned,
    as evaluation.estimate.txt and evaluation.truth.txt.
    """

    estimate: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="ESTIMATE")] = None
    """Estimated trajectory."""
    groundtruth: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="GROUNDTRUTH")
    ] = None
    """True trajectory."""
    runs: tuple[str, ...] = ()
    """Many estimates against one --truth, as FILE or NAME=FILE; those of one name are runs of one
    system, of which medians with intervals and box plots are given."""
    truth: Path | None = None
    """True trajectory of --runs."""
    deltas: tuple[float, ...] = ()
    """Of --runs: relative errors are given over each of these."""
    tables: tuple[str, ...] = ()
    """Write the tables also as latex, csv, or both (with --out)."""
    rerun: bool = False
    """Write paths and errors as evaluation.rrd for the Rerun viewer (with --out)."""
    align: str = "se3"
    """Alignment for ATE: se3, sim3 (relative errors are then of the scaled estimate), yaw (rotation
    about the world's z axis and translation), origin (first pose onto first) or none."""
    align_first: int | None = None
    """Align by so many poses from the start alone (se3, sim3, yaw)."""
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
    """frames.csv of ms-slam run: leave out the poses of frames that were not tracked. One that lies
    beside ESTIMATE leaves none out, but adds the error of tracked frames alone."""
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
    two_sided: bool = False
    """Points closer together than so many below the mean are outliers, too, as USME has it."""
    out: Path | None = None
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Print what was measured, and write it."""
    args = parse(Arguments, arguments, "ms-slam evaluate")
    if (args.estimate is None) != (args.groundtruth is None):
        raise InputError("Missing GROUNDTRUTH: trajectories are given as ESTIMATE GROUNDTRUTH")
    if (args.map is None) != (args.true_map is None):
        raise InputError("Missing file: maps are given as --map ESTIMATE --true-map GROUNDTRUTH")
    if (args.truth is None) != (not args.runs):
        raise InputError("Missing file: runs are given as --runs FILE ... --truth GROUNDTRUTH")
    if args.runs and (args.estimate is not None or args.map is not None):
        raise InputError("--runs stand alone: without ESTIMATE, GROUNDTRUTH and --map")
    if args.estimate is None and args.map is None and not args.runs:
        raise InputError(
            "Missing files: ESTIMATE GROUNDTRUTH, --runs FILE ... --truth GROUNDTRUTH, or "
            "--map ESTIMATE --true-map GROUNDTRUTH"
        )
    for name in () if args.runs else ("deltas",):
        _refuse_given(args, name, "--runs")
    for name in () if args.map else _OF_MAPS:
        _refuse_given(args, name, "--map")
    if (args.tables or args.rerun) and args.out is None:
        raise InputError("--tables and --rerun write files: they need --out FOLDER")
    from ms_slam_env.evaluation import evaluation_report as report
    from ms_slam_env.evaluation.many_runs import evaluate_runs
    from ms_slam_env.report.table_files import check_formats

    check_formats(args.tables)
    # Nothing is written before everything has been measured: bad input leaves no half of a result.
    parts = []
    if args.truth is not None:
        options = _trajectory_options(args)
        parts.append(evaluate_runs(args.runs, args.truth, options, args.deltas))
        print(parts[-1].summary)
    if args.estimate is not None and args.groundtruth is not None:
        options = _trajectory_options(args)
        parts.append(report.evaluate_trajectories(args.estimate, args.groundtruth, options))
        print(parts[-1].summary)
    if args.map is not None and args.true_map is not None:
        parts.append(report.evaluate_map_files(args.map, args.true_map, _map_options(args)))
        print(parts[-1].summary)
    if args.out is not None:
        report.write_evaluation(parts, args.out, args.tables, args.rerun)
    return 0


_OF_MAPS = (
    *("register", "cutoff_m", "remove_outliers", "neighbours", "std_ratio", "two_sided"),
    *("thresholds_m", "voxel_m", "samples"),
)


def _refuse_given(args: Arguments, name: str, needed: str) -> None:
    """Refuse an option that would change nothing."""
    if getattr(args, name) != getattr(Arguments, name):
        raise InputError(f"--{name.replace('_', '-')} needs {needed}")


def _trajectory_options(args: Arguments) -> TrajectoryOptions:
    from ms_slam_env.evaluation.trajectory_files import TrajectoryOptions

    return TrajectoryOptions(
        align=args.align,
        align_first=args.align_first,
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


def _map_options(args: Arguments) -> MapOptions:
    from ms_slam_env.evaluation.map_files import MapOptions

    return MapOptions(**{name: getattr(args, name) for name in _OF_MAPS})
