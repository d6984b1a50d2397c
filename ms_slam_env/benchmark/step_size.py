"""Experiment (a): at which size of step does each planner lose track?

Steps of s cm and s degrees, the same number of steps for every size. Run as
``python -m ms_slam_env.benchmark.step_size --help``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.benchmark.episode import EpisodeSpec, check_episodes, run_episode
from ms_slam_env.benchmark.figures import caption, colours, labels, legend_beside, new_figure, save
from ms_slam_env.benchmark.options import parse_options
from ms_slam_env.benchmark.planner_benchmark import DEFAULT_PLANNERS, check_names, seed_list
from ms_slam_env.benchmark.planner_report import Column, finished
from ms_slam_env.benchmark.runner import check_any_finished, failures, run_all
from ms_slam_env.benchmark.table import format_interval, markdown_table
from ms_slam_env.command_line import exit_code, parse, report_failures
from ms_slam_env.report import statistics
from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import Row, write_json
from ms_slam_env.report.statistics import Interval

PROGRAM = "python -m ms_slam_env.benchmark.step_size"
COLUMNS = (
    Column("lost", "lost [% of episodes]", 100),
    Column("ate_m", "ATE [mm]", 1000),
    Column("f_score_5cm", "F-score at 5 cm [%]", 100),
    Column("rcm", "completeness at 5 cm [%]", 100),
)


@dataclass(frozen=True)
class Arguments:
    """Planner x size of the motion step: share of lost episodes, ATE, F-score."""

    planners: tuple[str, ...] = DEFAULT_PLANNERS
    """NAME or module:Class, options appended as in greedy,rho_I=0.3."""
    scenes: tuple[str, ...] = ("living_room", "table")
    """Names of scenes, or mesh files."""
    sizes: tuple[float, ...] = (2, 4, 6, 8, 10, 12)
    """Sizes of step: so many centimetres and so many degrees."""
    episodes: int = 5
    """Seeds for each scene."""
    steps: int = 80
    """Length of an episode."""
    seeds: str = "validation"
    """Split that the seeds come from; a default read from them may not use the test seeds."""
    options: tuple[str, ...] = ()
    """Options of the environment, as in targets.M_I=0.05."""
    workers: int | None = None
    """Parallel processes; None for one a core."""
    out: Path = Path("results/step_size")
    """Folder of the results."""

    def specs(self) -> list[EpisodeSpec]:
        """Every episode."""
        return [
            EpisodeSpec(
                planner,
                scene,
                seed,
                steps=self.steps,
                step_m=size / 100,
                step_deg=size,
                options=parse_options(self.options),
            )
            for scene in self.scenes
            for seed in seed_list(self.seeds, self.episodes)
            for size in self.sizes
            for planner in self.planners
        ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the experiment; return the exit code."""
    args = parse(Arguments, arguments, PROGRAM)
    check_names(args.planners, args.scenes)
    check_episodes(args.specs())
    rows = run_all(args.specs(), run_episode, args.out, args.workers)
    check_any_finished(rows)
    summary = summarise(rows)
    write_json(
        args.out / "results.json",
        {
            "provenance": provenance(),
            "seeds": seed_list(args.seeds, args.episodes),
            "summary": [
                {"planner": planner, "size": size, **{k: asdict(v) for k, v in cell.items()}}
                for (planner, size), cell in summary.items()
            ],
            "episodes": rows,
        },
    )
    table = as_table(summary)
    (args.out / "table.md").write_text(table)
    save_figure(summary, args.out / "step_size.png")
    print(table)
    return report_failures(failures(rows), PROGRAM)


def summarise(rows: Sequence[Row]) -> dict[tuple[str, float], dict[str, Interval]]:
    """Share lost and medians with intervals, by planner and size of step."""
    cells: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for row in finished(rows):
        cell = (row["spec"]["planner"], row["spec"]["step_deg"])
        cells.setdefault(cell, []).append(row["result"])
    return {
        cell: {
            "lost": statistics.share_interval([r["lost"] for r in results]),
            **{
                column.metric: statistics.median_interval([r[column.metric] for r in results])
                for column in COLUMNS[1:]
            },
        }
        for cell, results in sorted(cells.items())
    }


def as_table(summary: dict[tuple[str, float], dict[str, Interval]]) -> str:
    """Markdown table, one line a planner and size."""
    return markdown_table(
        ["planner", "step [cm and deg]", *(column.heading for column in COLUMNS)],
        [
            [planner, f"{size:g}", *(format_interval(cell[c.metric], c.scale) for c in COLUMNS)]
            for (planner, size), cell in summary.items()
        ],
    )


def save_figure(summary: dict[tuple[str, float], dict[str, Interval]], path: Path) -> None:
    """Draw one panel a metric, one line a planner, the band its 95 % interval."""
    figure = new_figure(len(COLUMNS))
    panels = figure.subplots(1, len(COLUMNS))
    planners = list(dict.fromkeys(name for name, _ in summary))
    colour_of, label_of = colours(planners), labels(planners)
    for ax, column in zip(panels, COLUMNS, strict=True):
        for planner in planners:
            sizes = [size for name, size in summary if name == planner]
            cells = [summary[planner, size][column.metric] for size in sizes]
            low, value, high = (
                [column.scale * getattr(cell, part) for cell in cells]
                for part in ("low", "value", "high")
            )
            look = {"color": colour_of[planner]}
            ax.plot(sizes, value, "o-", label=label_of[planner], markersize=4, **look)
            ax.fill_between(sizes, low, high, alpha=0.15, linewidth=0, **look)
        ax.set_xlabel("step [cm and deg]")
        ax.set_ylabel(column.heading)
        ax.grid(alpha=0.3)
    panels[1].set_yscale("log")
    legend_beside(figure, panels[0])
    caption(figure, "Dot: median over episodes (lost: their share); band: its 95 % interval.")
    save(figure, path)


if __name__ == "__main__":
    sys.exit(exit_code(main, PROGRAM))
