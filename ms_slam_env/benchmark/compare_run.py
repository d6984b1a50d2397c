"""One SLAM backend on one sequence, in a process of its own.

``python -m ms_slam_env.benchmark.compare_run`` reads a specification as JSON from its input and
writes what it measured as JSON to its output. A new process for every run, because peak memory is
one number for the life of a process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ms_slam_env.errors import InputError
from ms_slam_env.parallel import limit_threads, thread_environment

WARM_UP = 5  # frames left out of the timing: buffers grow, kernels are loaded
THRESHOLDS_M = (0.02, 0.05)
_NAME = "compare_run"


@dataclass(frozen=True)
class CompareSpec:
    """A backend on a sequence.

    Attributes:
        sequence: a folder, or ``scene:seed[:noise[+perturbation ...]]``.
        backend: its name.
        image_size: such as 160x120.
        params: of the backend.
        frames: of a rendered sequence.
        speed_m_s: mean speed of the camera of a rendered sequence, where it does not turn.
        turn_deg_s: mean speed of rotation, where it turns.
        threads: cores that the backend may use.
        repeat: runs of one specification are told apart by this number.
    """

    sequence: str
    backend: str
    image_size: str
    params: dict[str, Any] = field(default_factory=dict)
    frames: int = 200
    speed_m_s: float = 0.5
    turn_deg_s: float = 30.0
    threads: int = 1
    repeat: int = 0


def run_apart(spec: CompareSpec) -> dict[str, Any]:
    """Run ``spec`` in a new process and return what ``run_here`` measured there.

    Raises:
        InputError: bad input, as the process said.
        RuntimeError: it failed otherwise; the last line of its complaint.
    """
    return run_module(_NAME, asdict(spec), spec.threads)


def run_module(name: str, spec: dict[str, Any], threads: int) -> dict[str, Any]:
    """What benchmark module ``name`` answers, as JSON, to ``spec`` as JSON, in a new process.

    Raises:
        InputError: bad input, as the process said.
        RuntimeError: it failed otherwise; the last line of its complaint.
    """
    environment = os.environ | thread_environment(threads)
    done = subprocess.run(
        [sys.executable, "-m", f"ms_slam_env.benchmark.{name}"],
        input=json.dumps(spec),
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    complaint = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    complaint = complaint.removeprefix(f"{name}: error: ")
    raise (InputError if done.returncode == 2 else RuntimeError)(complaint)


def run_here(spec: CompareSpec) -> dict[str, Any]:
    """Track the sequence from its true first pose and measure.

    Returns:
        ``ate_m`` and ``ate_max_m`` (SE(3)-aligned), ``ate_unaligned_m``, ``rpe_m`` and ``rpe_rad``
        (frame to frame), ``lost`` (share of the frames), medians ``cpu_ms`` (processor time of all
        threads a frame) and ``ms`` (by the clock), ``memory_mb`` (peak, what the backend alone
        needs of libraries included, frames not; None where the system does not tell), all of
        ``CostMeter.summary`` without the first frames,
        ``precision_2cm`` and so on of the map against the surface that the true trajectory saw,
        ``map_error_mm`` (median distance of a map point to it), ``points``, ``path_m``, ``frames``.
    """
    from ms_slam_env import metrics, slam
    from ms_slam_env.benchmark import compare_inputs
    from ms_slam_env.evaluation.run_sequence import run_sequence
    from ms_slam_env.sequences import HandheldPath

    path = HandheldPath(spec.frames, speed_m_s=spec.speed_m_s, turn_deg_s=spec.turn_deg_s)
    given = compare_inputs.load(spec.sequence, spec.image_size, path)
    costs = metrics.CostMeter(str(spec.params.get("device", "cpu")))
    system = slam.make(spec.backend, given.intrinsics, **spec.params)
    run = run_sequence(system, given, meter=costs)
    estimates = run.estimates
    cost = costs.summary(skip=WARM_UP)
    ate = metrics.ate_statistics(estimates, given.poses)
    return {
        "frames": len(estimates),
        "path_m": metrics.path_length(given.poses),
        "ate_m": ate.rmse,
        "ate_max_m": ate.max,
        "ate_unaligned_m": metrics.ate_rmse(estimates, given.poses, align="none"),
        "rpe_m": metrics.rpe_rmse(estimates, given.poses),
        "rpe_rad": metrics.rpe_rmse(estimates, given.poses, kind="rotation"),
        "lost": run.lost,
        **cost,
        "cpu_ms": cost["cpu_ms_median"],
        "ms": cost["ext_ms_median"],
        "memory_mb": cost["mem_peak_mb"],
        **_map_quality(system.surface_points(), given.surface),
    }


def _map_quality(points: np.ndarray, surface: np.ndarray) -> dict[str, Any]:
    """Errors of the map where its estimated poses placed it; None for an empty map."""
    from ms_slam_env.evaluation.map_quality import map_quality, share_keys

    keys = share_keys(THRESHOLDS_M, ("precision", "f_score"))
    if len(points) == 0:
        names = [key.replace("f_score", "f") for key in keys]
        return {"points": 0, "map_error_mm": None, **dict.fromkeys(names)}
    found = map_quality(points, surface, (*keys, "map_error_median_m"))
    return {
        "points": len(points),
        "map_error_mm": 1e3 * found["map_error_median_m"],
        **{key.replace("f_score", "f"): found[key] for key in keys},
    }


def main() -> int:
    """Run the specification on the input."""
    spec = CompareSpec(**json.load(sys.stdin))
    limit_threads(spec.threads)
    print(json.dumps(run_here(spec)))
    return 0


if __name__ == "__main__":
    from ms_slam_env.command_line import exit_code

    sys.exit(exit_code(main, _NAME))
