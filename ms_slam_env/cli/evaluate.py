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
    (or OBJ, glTF, STL, OFF); point clouds are used directly, meshes are sampled. With --out, writes
    evaluation.json, table.md, figures, and the matched, aligned poses as evaluation.estimate.txt
    and evaluation.truth.txt.
    """

    estimate: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="ESTIMATE")] = None
    """Estimated trajectory."""
    groundtruth: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="GROUNDTRUTH")
    ] = None
    """True trajectory."""
    runs: tuple[str, ...] = ()
    """Estimates to compare with one --truth, as FILE or NAME=FILE. Files that share a NAME are runs
    of one system, reported as medians with intervals and box plots."""
    truth: Path | None = None
    """True trajectory of --runs."""
    deltas: tuple[float, ...] = ()
    """Deltas over which --runs reports relative errors."""
    tables: tuple[str, ...] = ()
    """Write the tables also as latex, csv, or both (with --out)."""
    rerun: bool = False
    """Write paths and errors as evaluation.rrd for the Rerun viewer (with --out)."""
    align: str = "se3"
    """Alignment for ATE: se3, sim3 (relative errors are then of the scaled estimate), yaw (rotation
    about the world's z axis and translation), origin (first pose onto first) or none."""
    align_first: int | None = None
    """Align using only this many poses from the start (se3, sim3, yaw)."""
    delta: float = 1
    """Distance between the two poses of a relative error."""
    delta_unit: str = "frames"
    """Unit of --delta: frames, m (along the true path) or s."""
    pairs: str = "all"
    """Pose pairs for relative errors: all, or consecutive (each starts where the last one ends)."""
    tolerance: float = 0.1
    """Tolerance for a delta in m or s over all pairs, as a fraction of the delta."""
    segments: int = 1
    """Also report errors for this many equal segments of the trajectory."""
    segment_lengths_m: tuple[float, ...] = ()
    """Lengths of sub-trajectories for drift, as in KITTI; by default a tenth to a half of the
    path."""
    max_difference_s: float = 0.02
    """Largest difference between matching timestamps."""
    gap_s: float | None = None
    """Count a longer gap between poses of the estimate as lost; by default three times the median
    interval."""
    frames: Path | None = None
    """frames.csv of ms-slam run: leave out the poses of untracked frames. A frames.csv beside
    ESTIMATE is read without this option; it leaves out no pose and adds the error of tracked frames
    alone."""
    map: Path | None = None
    """Estimated map."""
    true_map: Path | None = None
    """True surface; or the folder of a sequence, whose depth and true poses give the surface."""
    register: str = "none"
    """Bring the map onto the true one first: none, icp, plane-icp or gicp."""
    cutoff_m: float = 0.5
    """Registration ignores point pairs farther apart than this."""
    thresholds_m: tuple[float, ...] = (0.02, 0.05)
    """Distance thresholds for precision, recall and F-score of the map."""
    voxel_m: float = 0.01
    """Downsample maps to one point per voxel of this edge length; 0 keeps all points. A true mesh
    is sampled by area and not downsampled."""
    samples: int = 200_000
    """Number of points sampled from a mesh."""
    remove_outliers: bool = False
    """Remove statistical outliers from the estimated map before comparing it."""
    neighbours: int = 20
    """Neighbours of each point for statistical outlier removal."""
    std_ratio: float = 2.0
    """Standard deviations above the mean beyond which a point is an outlier."""
    two_sided: bool = False
    """Also remove points that many standard deviations below the mean, as USME does."""
    noise_sigma_m: float = 0.01
    """Standard deviation of the sensor's depth; points of the map farther from the true surface
    than three of it (and the spacing of the true points, added in squares) are noise."""
    out: Path | None = None
    """Folder of the results."""


def main(arguments: Sequence[str]) -> int:
    """Measure, print the results and, with --out, write them."""
    args = parse(Arguments, arguments, "ms-slam evaluate")
    if (args.estimate is None) != (args.groundtruth is None):
        raise InputError("Missing GROUNDTRUTH: trajectories are given as ESTIMATE GROUNDTRUTH")
    if (args.map is None) != (args.true_map is None):
        raise InputError("Missing file: maps are given as --map ESTIMATE --true-map GROUNDTRUTH")
    if (args.truth is None) != (not args.runs):
        raise InputError("Missing file: runs are given as --runs FILE ... --truth GROUNDTRUTH")
    if args.runs and (args.estimate is not None or args.map is not None):
        raise InputError("--runs cannot be combined with ESTIMATE, GROUNDTRUTH or --map")
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
    # Write only after everything is measured, so that bad input leaves no partial result.
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
    *("noise_sigma_m", "thresholds_m", "voxel_m", "samples"),
)


def _refuse_given(args: Arguments, name: str, needed: str) -> None:
    """Refuse an option that would have no effect."""
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
