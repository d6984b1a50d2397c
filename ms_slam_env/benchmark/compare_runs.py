"""What the comparison of SLAM systems measures: a backend, or the trajectory of another system."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics, slam
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.command_runs import run_command
from ms_slam_env.config import parse_named
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.map_quality import THRESHOLDS_M, map_quality, share_keys
from ms_slam_env.evaluation.run_sequence import run_sequence
from ms_slam_env.evaluation.seen_surface import open_with_surface
from ms_slam_env.evaluation.trajectory_files import tracked_beside
from ms_slam_env.geometry import invert
from ms_slam_env.sequences import HandheldPath, Sequence, associate, read_trajectory
from ms_slam_env.sequences.trajectory import MAX_DIFFERENCE_S

MAP_METRICS = (
    *("map_error_median_m", *share_keys(THRESHOLDS_M, ("precision", "f_score"))),
    "map_points",
)
_WARM_UP = 5  # frames left out of the timing: buffers grow, kernels are loaded
_BLANK = "{sequence}"


@dataclass(frozen=True)
class CompareSpec:
    """A system on a sequence.

    Attributes:
        sequence: a folder, or ``scene:seed[:word[+word ...]]``.
        backend: ``NAME`` or ``NAME,parameter=value,...``; of a trajectory or a command any name.
        image_size: such as 160x120.
        frames: of a rendered sequence.
        speed_m_s: mean speed of the camera of a rendered sequence, where it does not turn.
        turn_deg_s: mean speed of rotation, where it turns.
        threads: cores that the backend may use.
        repeat: runs of one specification are told apart by this number.
        trajectory: TUM file that is judged in place of a backend.
        digest: of what it holds.
        timeout_s: of a command.
        command: ``command:PROGRAM ...`` that is run in place of a backend.
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
        """Of a rendered sequence."""
        return HandheldPath(self.frames, speed_m_s=self.speed_m_s, turn_deg_s=self.turn_deg_s)


@dataclass(frozen=True)
class TrajectoryPattern:
    """Trajectories of another system, a file a sequence.

    Attributes:
        name: of the system.
        pattern: path with ``{sequence}`` in the place of the sequence's name (of a folder its last
            part).
    """

    name: str
    pattern: str

    def file(self, sequence: str) -> Path:
        """The file of a sequence."""
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
        raise InputError(f"trajectories {text!r}: of several sequences the file needs {_BLANK}")
    return TrajectoryPattern(name, pattern)


def run_backend(spec: CompareSpec) -> dict[str, Any]:
    """Track the sequence from its true first pose and measure.

    Costs are those of the frames after the first; memory is the peak that the backend alone needs,
    libraries included, frames not. The map is judged against the surface that the true trajectory
    saw.
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
    """Let a program track the sequence, and measure its trajectory and its time.

    Times are of the whole program over the number of frames: its start counts, and its reading of
    the images. Memory and map are not known.
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
    """Measure a trajectory file as if a backend had said its poses; costs and map are not known.

    A frame without a pose holds the one before, as a backend does that is lost; those before the
    first hold that one. Which others were not tracked says a ``frames.csv`` beside the file.

    Raises:
        InputError: a file that cannot be read, or has fewer than two poses of the sequence.
    """
    return _judged(Path(spec.trajectory), _opened(spec))


def _opened(spec: CompareSpec) -> Sequence:
    from ms_slam_env.sequences import open_sequence

    return open_sequence(spec.sequence, spec.image_size, path=spec.path, with_truth=True)


def _judged(path: Path, sequence: Sequence) -> dict[str, Any]:
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
    return _errors(T_world_own @ poses[own[np.maximum(held, 0)]], sequence.poses, tracked)


def _errors(estimates: Float64, truth: Float64, tracked: NDArray[np.bool_]) -> dict[str, Any]:
    """Errors of poses (N, 4, 4) that start at the true first pose."""
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
