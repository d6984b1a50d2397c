"""Experiment (b): Table II of Saeedi et al., ICRA 2017: greedy divergence against random walk.

Free motion and fixed translation. Run as ``python -m ms_slam_env.benchmark.table_two --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark.figures import caption, colours, labels, new_figure, save
from ms_slam_env.benchmark.planner_report import Column, finished
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.experiments.harness.episodes import (
    DEFAULT_STEP_DEG,
    DEFAULT_STEP_M,
    EpisodeSpec,
    check_episodes,
    check_names,
    parse_options,
    run_episode,
    seed_list,
)
from ms_slam_env.experiments.harness.rows import check_any_finished, failures, run_all
from ms_slam_env.report import statistics
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.report.statistics import Interval
from ms_slam_env.report.tables import format_interval, markdown_table

PROGRAM = "python -m ms_slam_env.benchmark.table_two"
EXPERIMENTS = {
    "free motion": "MSActiveSLAM-FreeCamera-v0",
    "fixed translation": "MSActiveSLAM-FixedTranslation-v0",
}
PAPER_CUTS = {
    "free motion": {"ate_m": 1 - 0.1549 / 0.2343, "rer_m": 1 - 0.0518 / 0.0773},
    "fixed translation": {"ate_m": 1 - 0.0582 / 0.0854, "rer_m": 1 - 0.0726 / 0.0809},
}
"""By how much active SLAM cuts the errors of random walk in the paper's Table II."""

COLUMNS = (
    Column("ate_m", "ATE [mm]", 1000),
    Column("rer_m", "RER [mm]", 1000),
    Column("rcm", "RCM [%]", 100),
    Column("path_length_m", "path [m]"),
)


@dataclass(frozen=True)
class Arguments:
    """The paper's Table II: ATE and RER of an active planner against random walk."""

    active: str = "greedy"
    """The active planner, options appended as in greedy,rho_I=0.3."""
    baseline: str = "random"
    """What it is compared with."""
    scenes: tuple[str, ...] = ("living_room",)
    """Names of scenes, or mesh files; the paper has one living room."""
    episodes: int = 20
    """Seeds for each scene."""
    steps: int = 100
    """Length of an episode."""
    step_m: float = DEFAULT_STEP_M
    """Translation of a motion, metres."""
    step_deg: float = DEFAULT_STEP_DEG
    """Rotation of a motion, degrees."""
    seeds: str = "test"
    """Split that the seeds come from."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in targets.M_I=0.05."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/table_two")
    """Folder of the results."""

    def specs(self) -> list[EpisodeSpec]:
        """Every episode."""
        return [
            EpisodeSpec(
                planner,
                scene,
                seed,
                env_id,
                steps=self.steps,
                step_m=self.step_m,
                step_deg=self.step_deg,
                options=parse_options(self.options),
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for env_id in EXPERIMENTS.values()
            for planner in (self.baseline, self.active)
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names((args.baseline, args.active), args.scenes)
    check_episodes(args.specs())
    rows = run_all(args.specs(), run_episode, args.out, args.workers)
    check_any_finished(rows)
    experiments = {
        name: compare(rows, env_id, args.baseline, args.active)
        for name, env_id in EXPERIMENTS.items()
    }
    write_json(
        args.out / "results.json",
        {
            "provenance": provenance(),
            "seeds": seed_list(args.seeds, args.episodes),
            "summary": experiments,
            "paper_cuts": PAPER_CUTS,
            "episodes": rows,
        },
    )
    table = as_table(experiments)
    (args.out / "table.md").write_text(table)
    save_figure(rows, (args.baseline, args.active), args.out / "table_two.png")
    print(table)
    return report_failures(failures(rows), PROGRAM)


def compare(rows: Sequence[Row], env_id: str, baseline: str, active: str) -> dict[str, Any]:
    """One experiment: medians by planner, and the cut of each error by the active planner.

    Only episodes that both planners finished without an error are compared. ``rcm_tracked`` is the
    completeness over the episodes in which tracking was never lost.
    """
    results: dict[str, dict[tuple[str, int], dict[str, Any]]] = {baseline: {}, active: {}}
    for row in finished(rows):
        spec = row["spec"]
        if spec["env_id"] == env_id:
            results[spec["planner"]][spec["scene"], spec["seed"]] = row["result"]
    pairs = sorted(set(results[baseline]) & set(results[active]))
    summary: dict[str, Any] = {"episodes": len(pairs), "planners": {}, "cuts": {}}
    for planner, of_planner in results.items():
        episodes = [of_planner[pair] for pair in pairs]
        cell = {
            column.metric: statistics.median_interval([e[column.metric] for e in episodes])
            for column in COLUMNS
        }
        cell["lost"] = statistics.share_interval([e["lost"] for e in episodes])
        tracked = [e["rcm"] for e in episodes if not e["lost"]]
        cell["rcm_tracked"] = statistics.median_interval(tracked)
        summary["planners"][planner] = {name: asdict(value) for name, value in cell.items()}
    for metric in ("ate_m", "rer_m"):
        values, others = (
            [results[planner][pair][metric] for pair in pairs] for planner in (active, baseline)
        )
        summary["cuts"][metric] = asdict(statistics.relative_cut(values, others))
    return summary


def as_table(experiments: dict[str, dict[str, Any]]) -> str:
    """Markdown: one line an experiment and planner, then the cuts beside the paper's."""
    body, cuts = [], []
    for name, experiment in experiments.items():
        for planner, cell in experiment["planners"].items():
            shown = [format_interval(Interval(**cell[c.metric]), c.scale) for c in COLUMNS]
            tracked = format_interval(Interval(**cell["rcm_tracked"]), 100)
            lost = format_interval(Interval(**cell["lost"]), 100)
            body.append([name, planner, str(experiment["episodes"]), *shown, tracked, lost])
        cut, paper = experiment["cuts"], PAPER_CUTS[name]
        cuts.append(
            [
                name,
                *(
                    text
                    for metric in ("ate_m", "rer_m")
                    for text in (
                        format_interval(Interval(**cut[metric]), 100),
                        f"{100 * paper[metric]:.0f}",
                    )
                ),
            ]
        )
    headings = [column.heading for column in COLUMNS]
    return (
        markdown_table(
            ["experiment", "planner", "episodes", *headings, "RCM, tracked [%]", "lost [%]"], body
        )
        + "\n"
        + markdown_table(["experiment", "ATE cut [%]", "paper", "RER cut [%]", "paper"], cuts)
    )


def save_figure(rows: Sequence[Row], planners: Sequence[str], path: Path) -> None:
    """Draw the distribution of ATE and RER over episodes, by experiment and planner."""
    figure = new_figure(len(EXPERIMENTS) * 2)
    colour_of, label_of = colours(planners), labels(planners)
    panels = iter(figure.subplots(1, len(EXPERIMENTS) * 2))
    for name, env_id in EXPERIMENTS.items():
        for column in COLUMNS[:2]:
            ax = next(panels)
            for index, planner in enumerate(planners):
                values = column.scale * np.array(
                    [
                        row["result"][column.metric]
                        for row in finished(rows)
                        if (row["spec"]["env_id"], row["spec"]["planner"]) == (env_id, planner)
                    ]
                )
                ax.boxplot(
                    values,
                    positions=[index],
                    widths=0.5,
                    showfliers=False,
                    medianprops={"color": "black", "linewidth": 2},
                )
                jitter = np.random.default_rng(0).uniform(-0.15, 0.15, len(values))
                ax.plot(index + jitter, values, ".", color=colour_of[planner], alpha=0.6)
            ax.set_xticks(range(len(planners)), [label_of[planner] for planner in planners])
            if column.metric == "ate_m":
                ax.set_yscale("log")
            ax.set_ylabel(column.heading)
            ax.set_title(name)
    caption(
        figure, "Dots: episodes. Box: quartiles, median thick; whiskers: up to 1.5 box lengths."
    )
    save(figure, path)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
