"""One, two and three robots map a place until a share is covered: how much does a team save?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ms_slam_env import metrics
from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.benchmark.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    EpisodeSpec,
    make_env,
    seed_list,
)
from ms_slam_env.benchmark.experiment import Experiment, check_names
from ms_slam_env.config import Checked, bounded
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.coverage import team_share
from ms_slam_env.env.planners import Planner, Recovering, check_planner, make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.tables import Grouping, Row, Table, finished, make_table
from ms_slam_env.scenes import HOMES, Scene
from ms_slam_env.tasks import find_task

PLANNER = "ms_slam_baselines.team_nbv:TeamNextBestView"
METRICS = (
    *("steps_to_goal", "task_time_s", "mean_path_m", "team_path_m", "covered_share"),
    *("team_ate_m", "between_robots_m", "robots_lost"),
)
_APART_M = 0.5  # distance between the robots' starts
_STARTS = 200  # candidate starts, of which the closest to the first are used


@dataclass(frozen=True)
class TeamMappingSpec:
    """A team in a place; see :class:`TeamMapping` for the fields."""

    scene: str
    seed: int
    robots: int
    goal: float
    steps: int
    planner: str = PLANNER


@dataclass(frozen=True)
class TeamMapping(Experiment, Checked):
    """Teams of robots map a place to a coverage goal

    Robots start side by side at known poses, share an occupancy map and divide its frontiers; each
    has its own SLAM. The task ends when the team has mapped the required share of the reachable
    surface in its true place (time and mean path: USME equations 18 to 20). Robots do not see or
    obstruct each other, and a robot that does not recover from a loss stays where it is.
    """

    scenes: tuple[str, ...] = ("corridor", "home")
    """Names of scenes."""
    goals: tuple[float, ...] = (0.8, 0.5)
    """Share of the surface to map, one value per scene."""
    robots: tuple[int, ...] = (1, 2, 3)
    """Team sizes."""
    seeds: str = "validation"
    """Split that the seeds come from: train, validation or test; or your own, as 7000-7003."""
    teams: int = bounded(2, 1, 1000)
    """Seeds for each scene."""
    steps: int = bounded(200, 1, 100_000)
    """Largest number of steps of a robot; a goal not reached by then counts as never reached."""
    planner: str = PLANNER
    """Planner of each robot, with its options; with spread_m=0 it does not divide frontiers."""

    unit = "teams"

    def specs(self) -> list[TeamMappingSpec]:
        """Every team.

        Raises:
            InputError: a scene, split or planner that does not exist, goals that are not shares or
                not one per scene, a team without robots.
        """
        check_planner(self.planner)
        if len(self.goals) != len(self.scenes) or not all(0 < goal <= 1 for goal in self.goals):
            raise InputError(f"goals {self.goals} must be shares in (0, 1], one for each scene")
        if not self.robots or not all(1 <= number <= 10 for number in self.robots):
            raise InputError(f"robots {self.robots} must be sizes of teams from 1 to 10")
        check_names(self)
        return [
            self.spec(TeamMappingSpec, scene=scene, seed=seed, robots=robots, goal=goal)
            for scene, goal in zip(self.scenes, self.goals, strict=True)
            for seed in seed_list(self.seeds, self.teams)
            for robots in self.robots
        ]

    @staticmethod
    def run(spec: TeamMappingSpec) -> dict[str, Any]:
        """Let the team map until the goal is reached."""
        team = Team(spec)
        try:
            return team.map()
        finally:
            team.close()

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians by scene and size of the team, then every team."""
        note = "Never: the goal was not reached within the steps allowed."
        grouping = Grouping(("scene", "robots"), METRICS, count="teams_count")
        lines = [{**row["spec"], **row["result"]} for row in finished(rows)]
        return [
            grouping.table(rows, note=note),
            make_table(("scene", "seed", "robots", *METRICS), lines, "Teams"),
        ]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Share mapped over the steps, a panel for each scene."""
        panels = []
        for scene in dict.fromkeys(row["spec"]["scene"] for row in finished(rows)):
            own = [row for row in finished(rows) if row["spec"]["scene"] == scene]
            series = []
            for row in own:
                shares = row["result"]["covered_share_over_steps"]
                name = f"{row['spec']['robots']} robots"
                series.append(Series(name, list(range(len(shares))), shares, mode="lines"))
            panels.append(Panel("looks_at_steps", "covered_share", series, title=scene))
        return [Chart("team_mapping", "Share mapped by teams", "A line a team.", panels)]


class Team:
    """Robots in one scene, each in its own environment, whose planners share their map."""

    def __init__(self, spec: TeamMappingSpec) -> None:
        self._spec = spec
        self._envs = [make_env(_episode(spec)) for _ in range(spec.robots)]
        self._last: list[tuple[Any, dict[str, Any]]] = [self._envs[0].reset(seed=spec.seed)]
        starts = nearby_starts(
            self.worlds[0].scene, self._last[0][1]["T_world_camera"], spec.robots, spec.seed
        )
        for k in range(1, spec.robots):
            options = {"T_world_camera": starts[k]}
            self._last.append(self._envs[k].reset(seed=spec.seed + k, options=options))
        self._planners = [
            make_planner(spec.planner, world, spec.seed + k) for k, world in enumerate(self.worlds)
        ]
        for planner in self._planners:
            planner.reset()
        inner: Any = [_inner(planner) for planner in self._planners]
        for planner in inner:
            if hasattr(planner, "join"):
                planner.join(inner)
        self._stopped = [False] * spec.robots

    @property
    def worlds(self) -> list[ActiveSlamEnv]:
        """The environments of the robots."""
        return [cast(ActiveSlamEnv, env.unwrapped) for env in self._envs]

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()

    def map(self) -> dict[str, Any]:
        """Step all robots until the goal is reached, and return the team's measures."""
        shares = [self._share()]
        while shares[-1] < self._spec.goal and len(shares) <= self._spec.steps:
            for k in np.flatnonzero(~np.array(self._stopped)):
                self._step(int(k))
            shares.append(self._share())
            if all(self._stopped):
                break
        reached = shares[-1] >= self._spec.goal
        episodes = [world.episode for world in self.worlds]
        truths = [episode.trajectory_truth for episode in episodes]
        estimates = [episode.trajectory_estimate for episode in episodes]
        paths = [metrics.path_length(truth) for truth in truths]
        seconds = metrics.task_time([episode.timestamps for episode in episodes])
        between = metrics.inter_robot_rpe(estimates, truths).rmse if len(truths) > 1 else None
        return {
            "steps_to_goal": len(shares) - 1 if reached else math.inf,
            "task_time_s": seconds if reached else math.inf,
            "mean_path_m": metrics.mean_path_length(truths),
            "team_path_m": float(sum(paths)),
            "covered_share": shares[-1],
            "team_ate_m": metrics.team_ate(estimates, truths, "none").rmse,
            "between_robots_m": between,
            "robots_lost": sum(self._stopped),
            "covered_share_over_steps": [round(share, 4) for share in shares],
        }

    def _step(self, k: int) -> None:
        (observation, info), planner = self._last[k], self._planners[k]
        action = planner.act(observation, planner.known(info))
        observation, _, lost, _, info = self._envs[k].step(action)
        self._last[k] = observation, info
        self._stopped[k] = bool(lost)

    def _share(self) -> float:
        return team_share([world.coverage for world in self.worlds])


def nearby_starts(scene: Scene, first: Float64, count: int, seed: int) -> list[Float64]:
    """Poses (4, 4) of ``count`` robots: the first given, the others close to it but separated.

    Raises:
        InputError: there is no room for this many.
    """
    rng = np.random.default_rng([seed, 7])
    drawn = [scene.sample_start(rng) for _ in range(_STARTS)] if count > 1 else []
    drawn.sort(key=lambda pose: float(np.linalg.norm(pose[:3, 3] - first[:3, 3])))
    chosen = [first]
    for pose in drawn:
        away = [np.linalg.norm(pose[:3, 3] - other[:3, 3]) for other in chosen]
        if len(chosen) < count and min(away) >= _APART_M:
            chosen.append(pose)
    if len(chosen) < count:
        raise InputError(f"scene {scene.name!r}, seed {seed}, has no room for {count} robots")
    return chosen


def _episode(spec: TeamMappingSpec) -> EpisodeSpec:
    """Episode of a robot, with the step size of the task for this scene."""
    task = "home" if spec.scene in HOMES else "room"
    options = find_task(task).options
    return EpisodeSpec(
        *(spec.planner, spec.scene, spec.seed),
        steps=spec.steps,
        step_m=options.get("step_m", DEFAULT_STEP_M),
        step_deg=math.degrees(options.get("step_rad", math.radians(DEFAULT_STEP_DEG))),
        task=task,
    )


def _inner(planner: Planner) -> Planner:
    return planner.planner if isinstance(planner, Recovering) else planner
