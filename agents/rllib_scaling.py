"""Measure steps per second on Ray RLlib with different numbers of environment runners.

ms-slam train rllib scaling --runners 1 2 4 --out runs/rllib-scaling
"""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from dataclasses import asdict, replace
from typing import Any

from ms_slam_agents.environments import check_problem
from ms_slam_agents.train_rllib import make_run
from ms_slam_agents.trainers import RllibScaling as Scaling
from ms_slam_agents.training_run import alone

from ms_slam_env._runtime.progress import Bar
from ms_slam_env.errors import InputError
from ms_slam_env.report.records import to_plain
from ms_slam_env.report.results import RESULTS, write_result_folder
from ms_slam_env.report.tables import make_table


@alone
def scale(args: Scaling) -> int:
    """Measure and write; return the exit code.

    Raises:
        InputError: bad options, or fewer than one runner.
    """
    if not args.runners or min(args.runners) < 1:
        raise InputError(f"runners = {args.runners} must be numbers from 1 on")
    check_problem(args)
    rows = [
        measure(args, count) for count in Bar(args.runners, "scaling", unit="number of runners")
    ]
    alone = rows[0]["steps_per_s"] / rows[0]["runners"]
    for row in rows:
        row["scaling_efficiency"] = row["steps_per_s"] / (row["runners"] * alone)
    columns = ("runners", "steps_per_s", "scaling_efficiency")
    note = (
        f"{os.cpu_count()} processor threads for all runners and the learner. Efficiency is beside "
        "the runners of the first row."
    )
    write_result_folder(
        args.out,
        RESULTS,
        kind="rllib_scaling",
        title="Steps a second on Ray RLlib with so many environment runners",
        about="Synchronous PPO: runners play, then the learner learns while they wait.",
        tables=[make_table(columns, rows, note=note)],
        rows=[{"spec": {"runners": r["runners"]}, "result": r, "error": None} for r in rows],
        content={"config": to_plain(asdict(args))},
    )
    print((args.out / "table.md").read_text(encoding="utf-8"))
    return 0


def measure(args: Scaling, count: int) -> dict[str, Any]:
    """Steps per second with ``count`` runners, including updates of the network."""
    own: dict[str, Any] = {"num_envs": count, "runners": (count,), "total_timesteps": 1_000_000_000}
    with ExitStack() as stack:
        run = make_run(replace(args, **own), None, stack)
        run.advance(bool)
        before, begun = run.steps, time.monotonic()
        for _ in range(args.rounds):
            run.advance(bool)
        seconds = time.monotonic() - begun
    return {"runners": count, "steps_per_s": (run.steps - before) / seconds}
