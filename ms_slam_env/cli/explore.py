"""``ms-slam explore``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ms_slam_env._runtime.command_line import for_a_page, parse, report_failures


@dataclass(frozen=True)
class Arguments:
    """Search the design space of a SLAM backend for the best trade-offs of error and cost.

    The default configuration is the first trial. Repeat the same command to resume at any time:
    finished trials are kept. Writes explore.json, table.md, figures and the chosen configurations
    as YAML.
    """

    sequences: tuple[str, ...] = (
        "living_room:1000",
        "corridor:1001",
        "table:1002",
        "carpet:1003",
    )
    """Sequences to explore on: folders, or scene:seed[:word[+word ...]]."""
    held_out: tuple[str, ...] = ()
    """Sequences to test the front and the chosen configurations on."""
    objectives: tuple[str, ...] = ("ate_m", "ext_ms")
    """Objectives to minimise: ate_m, ate_max_m, ate_worst_m (of all sequences), ate_worst_ratio (to
    the default's), ext_ms, load_ms, mem_mb, energy_j, energy_model_j, map_error_mm, lost; M_I and
    M_D are maximised."""
    constraints: tuple[str, ...] = ()
    """Constraints, as in "ate_m<0.01", "M_I<0.02" or "M_I>0.02"."""
    parameters: tuple[str, ...] = ("algorithm",)
    """Parameters of the backend: NAME, NAME=low:high[:log], NAME=a,b,c; keep_every, image_size,
    pyramid_levels; or a group: paper, algorithm, frame, compiler, machine, kinectfusion."""
    config: Path | None = None
    """Configuration file (YAML) to start from; by default the surfel backend's own."""
    sampler: str = "tpe"
    """random, nsga2, tpe, gp or forest (random forests, as HyperMapper does)."""
    trials: int = 100
    """Total number of finished trials, including those of earlier calls."""
    seed: int = 0
    """Seed of the sampler."""
    workers: int = 1
    """Processes that share the trials."""
    ray: str | None = None
    """Address of a Ray cluster to use, such as "auto"; "local" for one on this machine."""
    image_size: str = "160x120"
    """Image size, unless the configuration sets one."""
    frames: int = 90
    """Number of frames of a rendered sequence."""
    speed_m_s: float = 0.5
    """Mean speed of the camera in a rendered sequence, while it does not turn."""
    turn_deg_s: float = 30.0
    """Mean speed of rotation, while it turns."""
    max_lost: float = 0.02
    """Largest share of frames that tracking may lose; a trial that loses more fails."""
    clock: str = "processor"
    """Measure execution time as "processor" time of all threads, or as "wall" time (needed on a
    GPU)."""
    reference_factor: float = 3.0
    """Reference point of the front's hypervolume, as a multiple of the default's results; worse
    results count as this."""
    for_divergence: tuple[float, float] | None = None
    """M_I and M_D of an application, nats; also name the best configuration for them."""
    tolerance: float = 1.2
    """Largest error, as a multiple of the default's, allowed for that configuration and for the
    levels of run-time adaptation."""
    out: Path = Path("results/explore")
    """Folder of the study and the results."""


def main(arguments: Sequence[str]) -> int:
    """Explore, write, and print the table."""
    args = parse(Arguments, arguments, "ms-slam explore")
    from ms_slam_env.slam.configuration import SlamConfiguration, read_configuration
    from ms_slam_env.tuning import (
        Exploration,
        ExplorationSettings,
        SlamEvaluator,
        run_exploration,
    )
    from ms_slam_env.tuning.objectives import FAILURE

    names = " ".join((*args.objectives, *args.constraints))
    base = SlamConfiguration() if args.config is None else read_configuration(args.config)
    evaluator = SlamEvaluator(
        args.sequences,
        args.frames,
        args.speed_m_s,
        args.turn_deg_s,
        args.image_size,
        args.max_lost,
        args.clock,
        map_error="map_error_mm" in names,
        baseline=base if "ate_worst_ratio" in names else None,
    )
    settings = ExplorationSettings(
        args.objectives,
        args.constraints,
        args.sampler,
        args.seed,
        reference_factor=args.reference_factor,
        context=evaluator.context(),
    )
    exploration = Exploration(
        evaluator,
        settings,
        args.parameters,
        base,
        args.held_out,
        args.for_divergence,
        args.tolerance,
    )
    results = run_exploration(exploration, args.out, args.trials, args.workers, args.ray)
    print(results.as_markdown())
    made = f"explore.json, table.md, figures and configurations (*.yaml){for_a_page(args.out)}"
    print(f"written: {args.out}/{made}", file=sys.stderr)
    failed = [row["result"].get(FAILURE) for row in results.rows]
    return report_failures(failed if all(failed) else [])
