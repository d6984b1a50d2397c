"""SLAM backends side by side: error, time, memory and map on the same sequences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ms_slam_env import slam
from ms_slam_env._runtime.parallel import limit_threads, thread_environment
from ms_slam_env.benchmark.command_runs import (
    check_command,
    command_of,
    is_command,
    name_of,
)
from ms_slam_env.benchmark.compare_runs import (
    CompareSpec,
    TrajectoryPattern,
    judge_command,
    judge_trajectory,
    parse_trajectories,
    run_backend,
)
from ms_slam_env.benchmark.compare_tables import comparison_tables
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.benchmark.file_hashes import digest
from ms_slam_env.camera import parse_image_size
from ms_slam_env.config import Checked, bounded, parse_named
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.report.charts import Chart, scatter
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table, finished
from ms_slam_env.scenes import PUBLISHED_ROOMS

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

_TIME = "cpu_ms_mean"  # the only one that is known of a command, too

PEERS = ("odometry,stock=true", "volumetric,stock=true")
"""OpenCV's odometry and Open3D's dense SLAM as they are."""


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
    OpenCV's odometry as it is, volumetric,stock=true Open3D's dense SLAM. Any other system is
    "NAME=command:PROGRAM --in {sequence} --out {trajectory}", NAME= for the tables: it reads a
    folder in the TUM layout and writes a TUM trajectory."""
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
    command_timeout_s: float = bounded(3600.0, 0.1, 1e6)
    """Seconds after which a command is stopped."""
    repeats: int = bounded(1, 1, 1000)
    """Runs of each; the tables show medians."""
    trajectories: tuple[str, ...] = ()
    """Systems from outside, as NAME=FILE: TUM files, camera to world, with {sequence} in the place
    of the sequence's name, as in orb=orb/{sequence}.txt."""
    reference: str = ""
    """Backend or trajectory that the others are set against in pairs; by default the first."""

    workers = 1
    fresh_process = True
    tracks = True

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
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
        """Libraries may start as many threads as a backend may use."""
        return thread_environment(self.threads)

    def specs(self) -> list[CompareSpec]:
        """Every run; those of one sequence and size are neighbours."""
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
            InputError: naming the files that were looked for.
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
        """Measure a backend, or the trajectory of another system."""
        limit_threads(spec.threads)
        if spec.trajectory:
            return judge_trajectory(spec)
        return judge_command(spec) if spec.command else run_backend(spec)

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """For each image size every sequence with medians, then differences in pairs."""
        names = dict.fromkeys(row["spec"]["backend"] for row in rows)
        return comparison_tables(rows, self.reference or next(iter(names), ""))

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Error against processor time, a panel for each image size, a mark for each sequence."""
        panels = []
        timed = [row for row in finished(rows) if row["result"].get(_TIME) is not None]
        for size in dict.fromkeys(row["spec"]["image_size"] for row in timed):
            own = [row for row in timed if row["spec"]["image_size"] == size]
            panels.append(replace(scatter(own, _TIME, "ate_m", "backend", log="xy"), title=size))
        caption = f"One mark a run. {_left_out(rows)}".rstrip()
        return [Chart("compare", "Error against time", caption, panels)] if panels else []


def _left_out(rows: Sequence[Row]) -> str:
    """Of which runs the figure has no mark: those that failed, and those of unknown time."""
    total = Counter(row["spec"]["backend"] for row in rows)
    failed = [row for row in rows if row["error"] is not None]
    untimed = [row for row in finished(rows) if row["result"].get(_TIME) is None]
    parts = [
        f"{name} ({why}: {count} of {total[name]})"
        for why, missing in (("failed", failed), ("time not known", untimed))
        for name, count in Counter(row["spec"]["backend"] for row in missing).items()
    ]
    return f"Not shown: {', '.join(parts)}." if parts else ""
