"""The learning curve of a training run, written as a result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ms_slam_agents.evaluation import evaluate_policy, paired_gain
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import PolicyFile, write_policy
from stable_baselines3.common.vec_env import VecEnv

from ms_slam_env.errors import InputError
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.results import RESULTS, Results, read_results, write_result_folder
from ms_slam_env.report.tables import Row, Table, make_table

BEST = "best.safetensors"
LATEST = "latest.safetensors"
BASELINE = "random walk"
POLICY = "policy"

_SCORES = ("return", "steps", "mapped_area_m2", "ate_unaligned_m", "lost_steps_share", "terminated")
_TRAINED = ("timesteps", "training_min", "return", "return_gain", "return_gain_sem", *_SCORES[1:])


@dataclass
class Curve:
    """Scores of a policy during training, and of reference planners on the same episodes.

    Attributes:
        episodes: number of episodes of each evaluation.
        references: planner to scores, as ``evaluate`` returns them.
        points: scores with ``timesteps`` and ``training_min``, the oldest first.
        config: the training script's options.
    """

    episodes: int
    references: dict[str, dict[str, Any]] = field(default_factory=dict)
    points: list[dict[str, Any]] = field(default_factory=list)
    config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def best(self) -> float:
        """Highest return of a point after the start of training; -inf without any."""
        found = [point["return"] for point in self.points if point["timesteps"]]
        return max(found, default=-float("inf"))

    @property
    def steps(self) -> int:
        """Steps trained at the last point; -1 without any."""
        return self.points[-1]["timesteps"] if self.points else -1

    def is_due(self, steps: int, every: int) -> bool:
        """Whether the policy after ``steps`` needs a point: the first, and one per ``every`` steps.

        A run that stopped between saving and evaluating adds its missing point when resumed.
        """
        return not self.points or bool(every and steps // every > self.steps // every)

    def add(self, timesteps: int, minutes: float, scores: Mapping[str, Any]) -> dict[str, Any]:
        """Add a point, with its gain over random walk if that is among the references.

        It replaces a point with the same steps, from a round that is repeated.
        """
        point = {"timesteps": timesteps, "training_min": round(minutes, 3), **scores}
        if BASELINE in self.references:
            point |= paired_gain(point["returns"], self.references[BASELINE]["returns"])
        self.points = [one for one in self.points if one["timesteps"] < timesteps] + [point]
        return point

    def judge(
        self, file: PolicyFile, validation: VecEnv, out: Path, deterministic: bool = False
    ) -> dict[str, Any]:
        """Evaluate a policy, add a point, write the curve, and the policy if it is the best."""
        known = file.metadata
        scores = evaluate_policy(validation, self.episodes, Policy(file), deterministic)
        if known.epochs and scores["return"] > self.best:
            write_policy(out / BEST, file)
        point = self.add(known.timesteps, known.minutes, scores)
        self.write(out)
        return point

    def in_words(self, point: Mapping[str, Any]) -> str:
        """Describe a point in one line."""
        gain = ""
        if "return_gain" in point:
            gain = (
                f", {point['return_gain']:+.2f} ± {point['return_gain_sem']:.2f} over random "
                f"walk's {self.references[BASELINE]['return']:.2f}"
            )
        return (
            f"validation return {point['return']:.2f}{gain}; mapped "
            f"{point['mapped_area_m2']:.1f} m2, ended early {point['terminated']:.0%}"
        )

    def write(self, out: Path) -> Results:
        """Write ``results.json``, ``table.md`` and the figure into folder ``out``."""
        return write_result_folder(
            out,
            RESULTS,
            kind="train",
            title="A policy while it is trained",
            about="Scores on the same validation episodes with the same random numbers each time, "
            "beside planners without training. Returns compare only under the same reward.",
            tables=self._tables(),
            charts=[self._chart()] if self.points else [],
            rows=self._rows(),
            content={"config": self.config, "episodes": self.episodes},
        )

    def _rows(self) -> list[Row]:
        named = [*self.references.items(), *((POLICY, point) for point in self.points)]
        return [{"spec": {"planner": n}, "result": scores, "error": None} for n, scores in named]

    def _tables(self) -> list[Table]:
        columns = _TRAINED if self.references else tuple(c for c in _TRAINED if "gain" not in c)
        note = f"Means of {self.episodes} validation episodes"
        note += "; gains over random walk, in pairs." if self.references else "."
        tables = [make_table(columns, self.points, "The policy", note)]
        if self.references:
            lines = [{"planner": name, **scores} for name, scores in self.references.items()]
            tables.append(make_table(("planner", *_SCORES), lines, "References"))
        return tables

    def _chart(self) -> Chart:
        timesteps = [point["timesteps"] for point in self.points]
        ends = [timesteps[0], timesteps[-1]]
        panels = []
        for key in ("return", "mapped_area_m2"):
            values = [point[key] for point in self.points]
            band = self._band() if key == "return" else ((), ())
            series = [Series(POLICY, timesteps, values, *band)]
            for name, scores in self.references.items():
                series.append(Series(name, ends, [scores[key]] * 2, mode="lines"))
            panels.append(Panel("timesteps", key, series))
        caption = f"Means of {self.episodes} episodes"
        caption += "; band: standard error of the gain over random walk" if self.references else ""
        return Chart("learning_curve", "Learning curve", caption, panels)

    def _band(self) -> tuple[list[float], list[float]]:
        """Lower and upper ends around the returns; empty without random walk."""
        known = [(p["return"], p["return_gain_sem"]) for p in self.points if "return_gain_sem" in p]
        if len(known) < len(self.points):
            return [], []
        return [mean - error for mean, error in known], [mean + error for mean, error in known]


def read_curve(path: Path) -> Curve:
    """Read the curve from the ``results.json`` of a training run.

    Raises:
        InputError: the file is not the result of a training run.
    """
    results = read_results(path)
    curve = Curve(0)
    try:
        curve.episodes = int(results.content["episodes"])
        curve.config = {**results.content.get("config", {}), "eval_episodes": curve.episodes}
        for row in results.rows:
            if row["spec"]["planner"] == POLICY:
                curve.points.append(_checked(row["result"], "timesteps", "training_min"))
            else:
                curve.references[row["spec"]["planner"]] = _checked(row["result"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no result of ms-slam train: {error!r}") from None
    return curve


def _checked(scores: dict[str, Any], *more: str) -> dict[str, Any]:
    """Check that scores have every number that tables and charts show."""
    for key in (*_SCORES, *more):
        float(scores[key])
    return scores
