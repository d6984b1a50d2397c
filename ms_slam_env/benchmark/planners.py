"""The planner benchmark: scenes x seeds x planners of a task, from the same start poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from ms_slam_env.benchmark.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    DOTS,
    EpisodeSpec,
    check_episodes,
    check_players,
    episode_specs,
    run_episode,
    seed_list,
    short_planner_names,
)
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.benchmark.planner_tables import (
    COMPARED,
    DETAILS,
    HEADLINE,
    RANKED_BY,
    across_scenes,
    better_than_each_other,
    from_the_same_start,
    policies_together,
    trainings_compared,
    with_losses,
)
from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, by_group, quartile_band, quartile_bands, scatter
from ms_slam_env.report.tables import Grouping, Row, Table, complete_cases, finished
from ms_slam_env.tasks import OWN, find_task

ALL = "all"
"""Name that stands for all of the package's tasks."""
PLANNERS = (
    *("random", "stationary", "greedy", "greedy-limited", "max-information"),
    *("nbv", "receding-nbv", "held-nbv", "belief", "graph-dopt"),
)
"""Planners that need no extra."""
EPISODES, LEADERBOARD_EPISODES = 10, 25
POOLED = "Policies of each training pooled"
"""Title of the tables that judge trainings in place of their policies."""
_PANELS = ("f_score_5cm_area", "f_score_5cm", "ate_m", "path_length_m")
_FLOOR_M = 5e-5  # smaller errors are drawn here on logarithmic axes


@dataclass(frozen=True)
class PlannerBenchmark(Experiment):
    """Planner benchmark

    Planners move the camera; a real SLAM estimates its path and maps the scene. A good planner maps
    much early (area under the F-score, completeness), keeps tracking (small ATE), and recovers when
    it is lost.
    """

    planners: tuple[str, ...] = PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    task: str = "room"
    """Task: room, home, arm, disturbed or module:function; all: the leaderboard."""
    scenes: tuple[str, ...] = ()
    """Names of scenes, or mesh files; by default the task's."""
    episodes: int | None = None
    """Number of seeds for each scene; by default 10, for the leaderboard 25."""
    steps: int | None = None
    """Length of an episode; by default the task's."""
    seeds: str = "test"
    """Split of the seeds: train, validation or test; or your own, such as 7000-7003 or 7000,7005,
    which are all played."""
    env_id: str | None = None
    """Environment; by default the task's."""
    step_m: float | None = None
    """Translation of a motion, metres; by default 0.12."""
    step_deg: float | None = None
    """Rotation of a motion, degrees; by default 12."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in lookahead.reference=live targets.M_I=0.05."""

    unit = rows_key = "episodes"
    run = staticmethod(run_episode)

    @property
    def tasks(self) -> Sequence[str]:
        """Names of the tasks."""
        return tuple(OWN) if self.task == ALL else (self.task,)

    def specs(self) -> list[EpisodeSpec]:
        """List every episode, task by task."""
        return [spec for name in self.tasks for spec in self._specs(name)]

    def _specs(self, name: str) -> list[EpisodeSpec]:
        """List the episodes of a task; it supplies the options that are not given."""
        task = find_task(name)
        step_rad = task.options.get("step_rad", math.radians(DEFAULT_STEP_DEG))
        usual = {
            "scenes": task.scenes,
            "steps": task.steps,
            "env_id": task.env_id,
            "step_m": task.options.get("step_m", DEFAULT_STEP_M),
            "step_deg": round(math.degrees(step_rad), 9),
        }
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        given = {key: value for key, value in own.items() if value not in (None, ())}
        shared = {"options": (), **usual, **given, "task": name}
        check_players(self.planners, shared["scenes"])
        compared = [{"planner": planner} for planner in self.planners]
        return episode_specs(shared, shared["scenes"], self._seeds, compared)

    @property
    def _seeds(self) -> list[int]:
        usual = LEADERBOARD_EPISODES if self.task == ALL else EPISODES
        seeds = seed_list(self.seeds, usual if self.episodes is None else self.episodes)
        if self.episodes not in (None, len(seeds)):
            raise InputError(
                f"episodes = {self.episodes}, and seeds = {self.seeds} are {len(seeds)}: "
                "leave --episodes out"
            )
        return seeds

    def prepare(self) -> None:
        """Start one episode of each planner."""
        check_episodes(self.specs())

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Tabulate each task pooled over all scenes, across scenes and for each scene."""
        return [table for task, of in _by_task(rows).items() for table in _tables(of, task)]

    def charts(self, rows: Sequence[Row]) -> list[Chart]:
        """Plot, per task, F-score over steps, metrics by planner, F-score against ATE, and ATE."""
        return [chart for task, of in _by_task(rows).items() for chart in _charts(of, task)]

    def content(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """Return the seeds and, for a single task, medians with intervals by planner."""
        seeds = {"seeds": self._seeds}
        if len(self.tasks) > 1:
            return seeds
        grouping = Grouping(("planner",), (*HEADLINE, *DETAILS), rank_by=RANKED_BY)
        pairs = complete_cases(rows, ("scene", "seed"), "planner")
        lines: Sequence[Mapping[str, Any]] = grouping.table(pairs).rows
        return {
            **seeds,
            "summary": {
                line["planner"]: {key: asdict(line[key]) for key in grouping.keys} for line in lines
            },
        }


def _by_task(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group rows by task, without tasks that finished no episode; a single task has no name."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["spec"].get("task", ""), []).append(row)
    found = {name: of for name, of in found.items() if finished(of)}
    return found if len(found) > 1 else dict(zip([""], found.values(), strict=False))


def _tables(rows: Sequence[Row], task: str) -> list[Table]:
    """Make the tables of one task; ``task`` prefixes their titles if there are several."""
    prefix = f"{task}: " if task else ""
    pairs = complete_cases(rows, ("scene", "seed"), "planner")
    headline = Grouping(("planner",), HEADLINE, rank_by=RANKED_BY, count="episodes")
    details = Grouping(("planner",), (RANKED_BY, *DETAILS), rank_by=RANKED_BY)
    spec = rows[0]["spec"]
    note = (
        "Medians with 95 % bootstrap intervals over the episodes that every planner finished, "
        f"of {_length(spec)} of {100 * spec['step_m']:g} cm / {spec['step_deg']:g} deg; "
        "best F-score first."
    )
    title = f"{prefix}over all scenes" if prefix else ""
    tables = [with_losses(headline.table(pairs, title, note), pairs)]
    tables.append(details.table(pairs, f"{prefix}Details"))
    tables += across_scenes(rows, f"{prefix}Across scenes")
    for metric in COMPARED:
        tables += better_than_each_other(rows, prefix, metric)
    tables += from_the_same_start(rows, prefix)
    tables += _policies_as_one(rows, pairs, f"{prefix}{POOLED}")
    scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    if len(scenes) > 1:
        for scene in scenes:
            of_scene = [row for row in pairs if row["spec"]["scene"] == scene]
            tables.append(with_losses(headline.table(of_scene, prefix + scene), of_scene))
    return tables


def _length(spec: Mapping[str, Any]) -> str:
    """Say how long an episode is: its simulated time if limited, else its steps."""
    task = OWN.get(spec.get("task", ""))
    seconds = {**(task().options if task else {}), **spec["options"]}.get("seconds")
    return (
        f"{seconds:g} simulated seconds in motions" if seconds else f"at most {spec['steps']} steps"
    )


def _policies_as_one(
    rows: Sequence[Row], pairs: Sequence[Mapping[str, Any]], title: str
) -> list[Table]:
    """Make tables of trainings instead of their policies; none without several policies of one."""
    if not policies_together(finished(rows)):
        return []
    grouping = Grouping(("planner",), HEADLINE, rank_by=RANKED_BY, count="episodes")
    of_pairs = policies_together(pairs)
    tables = [with_losses(grouping.table(of_pairs, title), of_pairs)] if of_pairs else []
    for metric in COMPARED:
        tables += trainings_compared(finished(rows), f"{title}: ", metric)
    return tables


def _charts(rows: Sequence[Row], task: str) -> list[Chart]:
    """Make the charts of one task, with the policies of a training drawn as one planner."""
    rows = policies_together(finished(rows)) or rows
    ranking = Grouping(("planner",), (RANKED_BY,), rank_by=RANKED_BY).table(rows)
    best = [str(line["planner"]) for line in ranking.rows]
    label = short_planner_names(best).__getitem__
    prefix, title = (f"{task}_", f"{task}: ") if task else ("", "")

    def runs(name: str, key: str) -> list[Any]:
        done = [r["result"] for r in finished(rows) if r["spec"]["planner"] == name]
        return [result[key] for result in done if key in result]

    looks = max((row["result"]["looks_at_steps"] for row in finished(rows)), key=len)
    scores = [quartile_band(label(n), looks, runs(n, "f_score_5cm_over_steps")) for n in best]
    errors = [
        # The error at step 0 is zero, which a logarithmic axis cannot show.
        quartile_band(label(n), looks[1:], [ate[1:] for ate in ates], _FLOOR_M)
        for n in best
        if (ates := runs(n, "ate_over_steps"))  # older rows have none
    ]
    charts = [
        Chart(
            f"{prefix}f_score_over_steps",
            f"{title}F-score over the steps",
            *quartile_bands("looks_at_steps", "f_score_5cm_over_steps", scores),
        ),
        Chart(
            f"{prefix}planners",
            f"{title}Measures by planner",
            DOTS,
            by_group(rows, "planner", _PANELS, ("ate_m",), best, label),
        ),
        Chart(
            f"{prefix}f_score_ate",
            f"{title}F-score against ATE",
            "One mark an episode.",
            [scatter(rows, "ate_m", RANKED_BY, "planner", "x", _FLOOR_M, label)],
        ),
        Chart(
            f"{prefix}ate_over_steps",
            f"{title}Error over the steps",
            *quartile_bands("looks_at_steps", "ate_over_steps", errors, "y"),
        ),
    ]
    return charts if errors else charts[:-1]
