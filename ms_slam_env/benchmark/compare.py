"""SLAM backends side by side: error, time, memory and map on the same sequences."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.threads import limit_threads, thread_environment
from ms_slam_env.benchmark.command_runs import (
    check_command,
    command_of,
    is_command,
    name_of,
    run_command,
)
from ms_slam_env.benchmark.compare_tables import comparison_tables
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.benchmark.rows import digest
from ms_slam_env.camera import parse_image_size
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.evaluation.map_quality import THRESHOLDS_M, map_quality, share_keys
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.seen_surface import open_with_surface
from ms_slam_env.evaluation.trajectory_files import tracked_beside
from ms_slam_env.geometry import invert
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.tables import Row, Table, finished
from ms_slam_env.scenes import PUBLISHED_ROOMS
from ms_slam_env.sequences import HandheldPath, associate, read_trajectory
from ms_slam_env.sequences import Sequence as RGBDSequence
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S

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
"""A clean room, every scene with noise, and the faults of recordings, alone and together."""

_TIME = "cpu_ms_mean"  # the only processor time that is also known for a command

PEERS = ("odometry,stock=true", "volumetric,stock=true", *slam.PEERS)
"""OpenCV's odometry and Open3D's dense SLAM, unmodified; other libraries at their best."""


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
    OpenCV's unmodified odometry, volumetric,stock=true Open3D's dense SLAM. open3d, small_gicp and
    kiss_icp are other libraries with their best parameters. Any other system is
    "NAME=command:PROGRAM --in {sequence} --out {trajectory}", where NAME is for the tables: it
    reads a folder in the TUM layout and writes a TUM trajectory."""
    image_sizes: tuple[str, ...] = ("160x120", "320x240")
    """Sizes of the images, such as 160x120."""
    frames: int = bounded(200, 10, 100_000)
    """Number of frames of a rendered sequence."""
    speed_m_s: float = 0.5
    """Mean speed of the camera in a rendered sequence, while it does not turn."""
    turn_deg_s: float = 30.0
    """Mean speed of rotation, while it turns."""
    threads: int = bounded(1, 1, 1024)
    """Cores that a backend may use."""
    command_timeout_s: float = bounded(3600.0, 0.1, 1e6)
    """Seconds after which a command is stopped."""
    repeats: int = bounded(1, 1, 1000)
    """Number of runs of each backend on each sequence; the tables show medians."""
    trajectories: tuple[str, ...] = ()
    """Trajectories of external systems, as NAME=FILE: TUM files, camera to world, with {sequence}
    in place of the sequence's name, as in orb=orb/{sequence}.txt."""
    reference: str = ""
    """Backend or trajectory to compare the others with, pairwise; by default the first."""

    workers = 1
    fresh_process = True
    tracks = True

    def __post_init__(self) -> None:
        """Refuse options that would fail every run."""
        super().__post_init__()
        for name in ("sequences", "backends", "image_sizes"):
            if not getattr(self, name):
                raise InputError(f"{type(self).__name__}.{name} is empty")
        for text in self.backends:
            if is_command(text):
                check_command(text)
            else:
                slam.check_parameters(*parse_named(text, "backend"))
        from ms_slam_env.sequences import check_sequence

        for text in self.sequences:
            check_sequence(text)
        for size in self.image_sizes:
            parse_image_size(size)
        names = [*map(name_of, self.backends), *(pattern.name for pattern in self._patterns())]
        if len(set(names)) < len(names):
            raise InputError(f"backends and trajectories {', '.join(names)} must differ")
        for pattern in self._patterns():
            files = {pattern.file(sequence) for sequence in self.sequences}
            if len(files) < len(set(self.sequences)):
                raise InputError(
                    f"trajectories {pattern.pattern!r}: two of the sequences have the same file"
                )
        if self.reference and self.reference not in names:
            raise unknown("reference", self.reference, names)

    def environment(self) -> Mapping[str, str]:
        """Limit the libraries' threads to those that a backend may use."""
        return thread_environment(self.threads)

    def specs(self) -> list[CompareSpec]:
        """List every run, grouped by sequence and image size within a repeat."""
        shared = self.frames, self.speed_m_s, self.turn_deg_s, self.threads
        found = []
        for repeat in range(self.repeats):
            for sequence in self.sequences:
                for size in self.image_sizes:
                    made = [
                        CompareSpec(
                            *(sequence, name_of(b), size, *shared, repeat),
                            timeout_s=self.command_timeout_s,
                            command=command_of(b) if is_command(b) else "",
                        )
                        for b in self.backends
                    ]
                    files = [(one.name, one.file(sequence)) for one in self._patterns()]
                    found += made + [
                        CompareSpec(sequence, name, size, *shared, 0, str(file), digest(file))
                        for name, file in files
                        if repeat == 0
                    ]
        return found

    def prepare(self) -> None:
        """Refuse a system without a single trajectory.

        Raises:
            InputError: names the missing files.
        """
        for pattern in self._patterns():
            files = [pattern.file(sequence) for sequence in self.sequences]
            if not any(file.is_file() for file in files):
                raise InputError(f"no trajectory of {pattern.name}: {', '.join(map(str, files))}")

    def _patterns(self) -> list[TrajectoryPattern]:
        several = len(self.sequences) > 1
        return [parse_trajectories(text, several) for text in self.trajectories]

    @staticmethod
    def run(spec: CompareSpec) -> dict[str, Any]:
        """Measure a backend, a command, or the trajectory of an external system."""
        limit_threads(spec.threads)
        if spec.trajectory:
            return judge_trajectory(spec)
        return judge_command(spec) if spec.command else judge_backend(spec)

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Tabulate, for each image size, the sequences with medians, then paired differences."""
        names = dict.fromkeys(row["spec"]["backend"] for row in rows)
        return comparison_tables(rows, self.reference or next(iter(names), ""))

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Plot error against processor time, one panel per image size, one mark per run."""
        panels = []
        timed = [row for row in finished(rows) if row["result"].get(_TIME) is not None]
        for size in dict.fromkeys(row["spec"]["image_size"] for row in timed):
            own = [row for row in timed if row["spec"]["image_size"] == size]
            panels.append(replace(scatter(own, _TIME, "ate_m", "backend", log="xy"), title=size))
        caption = f"One mark a run. {_left_out(rows)}".rstrip()
        return [Chart("compare", "Error against time", caption, panels)] if panels else []


def _left_out(rows: Sequence[Row]) -> str:
    """Name the runs that the figure leaves out: failed, or of unknown time."""
    total = Counter(row["spec"]["backend"] for row in rows)
    failed = [row for row in rows if row["error"] is not None]
    untimed = [row for row in finished(rows) if row["result"].get(_TIME) is None]
    parts = [
        f"{name} ({why}: {count} of {total[name]})"
        for why, missing in (("failed", failed), ("time not known", untimed))
        for name, count in Counter(row["spec"]["backend"] for row in missing).items()
    ]
    return f"Not shown: {', '.join(parts)}." if parts else ""


MAP_METRICS = (
    *("map_error_median_m", *share_keys(THRESHOLDS_M, ("precision", "f_score"))),
    "map_points",
)
_WARM_UP = 5  # frames left out of the timing: buffers grow, kernels are loaded
_BLANK = "{sequence}"


@dataclass(frozen=True)
class CompareSpec:
    """One run of a system on a sequence.

    Attributes:
        sequence: a folder, or ``scene:seed[:word[+word ...]]``.
        backend: ``NAME`` or ``NAME,parameter=value,...``; any name for a trajectory or a command.
        image_size: such as 160x120.
        frames: number of frames of a rendered sequence.
        speed_m_s: mean speed of the camera in a rendered sequence, while it does not turn.
        turn_deg_s: mean speed of rotation, while it turns.
        threads: cores that the backend may use.
        repeat: number that tells repeated runs apart.
        trajectory: TUM file that is evaluated instead of a backend.
        digest: digest of that file's content.
        timeout_s: seconds after which a command is stopped.
        command: ``command:PROGRAM ...`` that is run instead of a backend.
    """

    sequence: str
    backend: str
    image_size: str
    frames: int = 200
    speed_m_s: float = 0.5
    turn_deg_s: float = 30.0
    threads: int = 1
    repeat: int = 0
    trajectory: str = ""
    digest: str = ""
    timeout_s: float = 3600.0
    command: str = ""

    @property
    def path(self) -> HandheldPath:
        """The camera path of a rendered sequence."""
        return HandheldPath(self.frames, speed_m_s=self.speed_m_s, turn_deg_s=self.turn_deg_s)


@dataclass(frozen=True)
class TrajectoryPattern:
    """Trajectories of an external system, one file per sequence.

    Attributes:
        name: name of the system.
        pattern: path with ``{sequence}`` in place of the sequence's name (for a folder, the last
            part of its path).
    """

    name: str
    pattern: str

    def file(self, sequence: str) -> Path:
        """Return the file for a sequence."""
        name = Path(sequence).name if "/" in sequence else sequence
        return Path(self.pattern.replace(_BLANK, name))


def parse_trajectories(text: str, several: bool) -> TrajectoryPattern:
    """Read ``NAME=FILE``.

    Raises:
        InputError: another form, or one file for several sequences.
    """
    name, sign, pattern = text.partition("=")
    if not (name and sign and pattern):
        raise InputError(f"trajectories {text!r} are not NAME=FILE, as in orb=orb/{_BLANK}.txt")
    if several and _BLANK not in pattern:
        raise InputError(f"trajectories {text!r}: with several sequences the file needs {_BLANK}")
    return TrajectoryPattern(name, pattern)


def judge_backend(spec: CompareSpec) -> dict[str, Any]:
    """Track the sequence from its true first pose and measure.

    Costs exclude the first frames; memory is the backend's own peak, including libraries but not
    frames. The map is evaluated against the surface seen from the true trajectory.
    """
    given = open_with_surface(spec.sequence, spec.image_size, spec.path)
    name, params = parse_named(spec.backend, "backend")
    costs = metrics.CostMeter(str(params.get("device", "cpu")))
    system = slam.make(name, given.intrinsics, **params)
    run = run_sequence(system, given, meter=costs)
    return {
        **_errors(run.estimates, given.poses, run.tracking_ok),
        **costs.summary(skip=_WARM_UP),
        **map_quality(system.surface_points(), given.surface, MAP_METRICS),
    }


def judge_command(spec: CompareSpec) -> dict[str, Any]:
    """Run a program over the sequence; measure its trajectory and its time.

    Times are those of the whole program divided by the number of frames, including its start and
    its reading of images. Memory and map are not measured.
    """
    sequence = _opened(spec)
    with tempfile.TemporaryDirectory(prefix="ms-slam-compare-") as folder:
        path = Path(folder) / "trajectory.txt"
        cost = run_command(spec.command, sequence, path, spec.timeout_s)
        found = _judged(path, sequence)
    return {
        **found,
        "ext_ms": 1e3 * cost.ext_s / len(sequence),
        "cpu_ms_mean": 1e3 * cost.cpu_s / len(sequence),
    }


def judge_trajectory(spec: CompareSpec) -> dict[str, Any]:
    """Measure a trajectory file like the poses of a backend; costs and map are not measured.

    A frame without a pose keeps the previous pose, as in a backend that is lost; frames before the
    first pose get that pose. A ``frames.csv`` beside the file marks other untracked frames.

    Raises:
        InputError: the file cannot be read, or has fewer than two poses of the sequence.
    """
    return _judged(Path(spec.trajectory), _opened(spec))


def _opened(spec: CompareSpec) -> RGBDSequence:
    from ms_slam_env.sequences import open_sequence

    return open_sequence(spec.sequence, spec.image_size, path=spec.path, with_truth=True)


def _judged(path: Path, sequence: RGBDSequence) -> dict[str, Any]:
    placed = placed_poses(path, sequence)
    return _errors(placed.poses, sequence.poses, placed.tracked)


@dataclass(frozen=True)
class PlacedPoses:
    """The poses of a trajectory file at the frames of a sequence.

    Attributes:
        poses: (N, 4, 4) T_world_camera; a frame without a pose holds the last one.
        tracked: (N,) whether the frame has a pose, and no ``frames.csv`` calls it lost.
        T_world_own: (4, 4) from the world of the file, whose first pose is put on the true one.
    """

    poses: Float64
    tracked: NDArray[np.bool_]
    T_world_own: Float64


def placed_poses(path: Path, sequence: RGBDSequence) -> PlacedPoses:
    """Read a TUM file and put its poses on the frames of a sequence.

    Raises:
        InputError: the file cannot be read, or has fewer than two poses of the sequence.
    """
    times, poses = read_trajectory(path)
    own, at = associate(times, sequence.timestamps, MAX_DIFFERENCE_S)
    if len(own) < 2:
        raise InputError(
            f"{path} has {len(own)} poses at timestamps of {sequence.name}; at least 2 are needed"
        )
    said = tracked_beside(path, times)
    tracked = np.zeros(len(sequence), dtype=bool)
    tracked[at] = True if said is None else said[own]
    held = np.searchsorted(at, np.arange(len(sequence)), side="right") - 1
    T_world_own = sequence.poses[at[0]] @ invert(poses[own[0]])  # a backend starts at the truth
    return PlacedPoses(T_world_own @ poses[own[np.maximum(held, 0)]], tracked, T_world_own)


def _errors(estimates: Float64, truth: Float64, tracked: NDArray[np.bool_]) -> dict[str, Any]:
    """Measure the errors of poses (N, 4, 4) that start at the true first pose."""
    ate = metrics.ate_statistics(estimates, truth)
    return {
        "frames": len(estimates),
        "path_m": metrics.path_length(truth),
        "ate_m": ate.rmse,
        "ate_max_m": ate.max,
        "ate_unaligned_m": metrics.ate_rmse(estimates, truth, align="none"),
        "rpe_m": metrics.rpe_rmse(estimates, truth),
        "rpe_rad": metrics.rpe_rmse(estimates, truth, kind="rotation"),
        **metrics.tracked_errors(estimates, truth, tracked),
        "lost_share": 1.0 - float(tracked.mean()),
    }
