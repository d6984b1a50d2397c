"""Experiment: what each term of the reward contributes to a planner's return."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env.benchmark.episodes import (
    EpisodeSpec,
    SteppedExperiment,
    make_env,
    play,
    short_planner_names,
)
from ms_slam_env.benchmark.planner_tables import from_the_same_start
from ms_slam_env.env.planners import make_planner
from ms_slam_env.env.reward import DIVERGENCE_AND_ERROR
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import Table, grouped, make_table

TERMS = {
    "return_divergence": ("intensity_divergence", "depth_divergence"),
    "return_ate": ("ate_growth",),
    "return_lost": ("lost", "lost_for_good"),
    "return_blocked": ("blocked",),
}
"""Columns, each the sum of these terms over an episode."""


def run_terms(spec: EpisodeSpec) -> dict[str, Any]:
    """Play an episode; return its reward by term, its length and end."""
    env = make_env(spec)
    sums: Counter[str] = Counter()
    try:
        world: Any = env.unwrapped

        def after_step(step: int) -> None:
            if step:
                sums.update(world.episode.reward_terms)

        planner = make_planner(spec.planner, world, spec.seed)
        played = play(env, planner, spec.seed, after_step=after_step)
    finally:
        env.close()
    of_terms = {key: sum(sums[name] for name in names) for key, names in TERMS.items()}
    return {
        **{key: played[key] for key in ("return", "steps", "terminated", "lost_steps_share")},
        **{key: float(value) for key, value in of_terms.items()},
        "ate_unaligned_m": played["ate_over_time"][-1],
    }


@dataclass(frozen=True)
class RewardShares(SteppedExperiment):
    """What each term of the reward contributes

    The default reward of an environment without a task, in episodes of the default length. A
    reward is sound if a planner earns most by doing what it asks for: keeping the divergences near
    their targets, and the error small. Neither standing still nor getting lost does.
    """

    planners: tuple[str, ...] = ("stationary", "random", "greedy")
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = ("living_room", "corridor", "table", "wall")
    task: str = "room"
    """Task that supplies other options than the reward."""
    episodes: int = 5
    steps: int = 150
    seeds: str = "validation"
    options: tuple[str, ...] = (f"reward={DIVERGENCE_AND_ERROR}",)

    run = staticmethod(run_terms)

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """One line per planner: means, and in how many pairs it earns more than each other."""
        names = short_planner_names(row["spec"]["planner"] for row in rows)
        lines: list[Mapping[str, Any]] = []
        for (planner,), results in grouped(rows, ("planner",)).items():
            line = {key: float(np.mean([one[key] for one in results])) for key in _SHOWN}
            lines.append({"planner": names[planner], "episodes": len(results), **line})
        note = "Means over the episodes; the terms sum to the return."
        means = make_table(("planner", "episodes", *_SHOWN), lines, note=note)
        return [means, *from_the_same_start(rows, metric="return")]


_SHOWN = ("return", *TERMS, "terminated")
