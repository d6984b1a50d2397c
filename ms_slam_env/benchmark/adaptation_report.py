"""Tables and figures of run-time adaptation against fixed configurations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ms_slam_env.benchmark.figures import (
    caption,
    colour,
    legend_beside,
    new_figure,
    plain_log_ticks,
    save,
)
from ms_slam_env.benchmark.planner_report import Column
from ms_slam_env.report import statistics
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import format_interval, markdown_table

COLUMNS = (
    Column("cpu_ms", "processor time a frame [ms]"),
    Column("ate_m", "ATE [mm]", 1000),
    Column("ate_online_m", "ATE as predicted [mm]", 1000),
    Column("processed", "frames processed [%]", 100),
    Column("lost", "frames lost [%]", 100),
)
_ADAPTIVE = "adaptive"
_SMALLEST_CHANGE = 1e-4  # nats; what is below is drawn there


def competitors(rows: Sequence[Row]) -> list[str]:
    """Names of those that ran, in the order of the first sequence."""
    return list(rows[0]["result"]["runs"])


def values(rows: Sequence[Row], name: str, metric: str) -> list[float]:
    """One figure of a competitor, a number a sequence."""
    return [row["result"]["runs"][name][metric] for row in rows]


def summarise(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Of every competitor the median of each figure over sequences, with 95 % intervals."""
    return [
        {
            "name": name,
            **{
                column.metric: asdict(statistics.median_interval(values(rows, name, column.metric)))
                for column in COLUMNS
            },
            "sequences": len(rows),
        }
        for name in competitors(rows)
    ]


def comparison(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What adaptation cuts of each fixed configuration's median time and error, paired."""
    cuts = []
    for name in competitors(rows):
        if name == _ADAPTIVE:
            continue
        cut: dict[str, Any] = {"against": name}
        for metric in ("cpu_ms", "ate_m"):
            own, other = (values(rows, who, metric) for who in (_ADAPTIVE, name))
            cut[f"{metric}_cut"] = asdict(statistics.relative_cut(own, other))
            cut[f"{metric}_lower_share"] = float(np.mean(np.less(own, other)))
        cuts.append(cut)
    return cuts


def tables(rows: Sequence[Row]) -> str:
    """Markdown: every competitor's figures, then what adaptation cuts."""
    everyone = markdown_table(
        ["SLAM", *(column.heading for column in COLUMNS)],
        [
            [
                name,
                *(
                    format_interval(
                        statistics.median_interval(values(rows, name, c.metric)), c.scale
                    )
                    for c in COLUMNS
                ),
            ]
            for name in competitors(rows)
        ],
    )
    cuts = markdown_table(
        ["adaptive against", "time cut [%]", "ATE cut [%]", "sequences with lower ATE [%]"],
        [
            [
                cut["against"],
                format_interval(statistics.Interval(**cut["cpu_ms_cut"]), 100),
                format_interval(statistics.Interval(**cut["ate_m_cut"]), 100),
                f"{100 * cut['ate_m_lower_share']:.0f}",
            ]
            for cut in comparison(rows)
        ],
    )
    note = f"Medians of {len(rows)} sequences with 95 % intervals; a negative cut is a rise.\n"
    return f"{everyone}\n{cuts}\n{note}"


def save_figures(rows: Sequence[Row], out: Path) -> list[Path]:
    """Draw error against time, and a sequence along time."""
    return [_save_scatter(rows, out / "error_time.png"), _save_time_line(rows[0], out)]


def _save_scatter(rows: Sequence[Row], path: Path) -> Path:
    """ATE against processor time: a dot a sequence, a large mark the median."""
    figure = new_figure(1, width=9.0, height=3.8)
    ax = figure.subplots()
    for index, name in enumerate(competitors(rows)):
        ms, ate = values(rows, name, "cpu_ms"), 1000 * np.array(values(rows, name, "ate_m"))
        marker = "*" if name == _ADAPTIVE else "o"
        ax.scatter(ms, ate, s=10, alpha=0.4, color=colour(index))
        ax.scatter(
            np.median(ms), np.median(ate), s=110, marker=marker, color=colour(index), label=name
        )
    ax.set_yscale("log")
    plain_log_ticks(ax.yaxis)
    ax.set_xlim(left=0)
    ax.set_xlabel("processor time a frame [ms]")
    ax.set_ylabel("ATE [mm]")
    ax.grid(alpha=0.3)
    legend_beside(figure, ax)
    caption(figure, "One dot a sequence;\nlarge marks are medians.")
    return save(figure, path)


def _save_time_line(row: Mapping[str, Any], out: Path) -> Path:
    """Change between frames with its thresholds, and the configuration in force."""
    result = row["result"]
    figure = new_figure(1, width=8.0, height=3.8)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    frames = np.arange(len(result["change"]))
    above.plot(frames, np.maximum(result["change"], _SMALLEST_CHANGE), lw=1)
    for threshold in result["thresholds"]:
        above.axhline(threshold, color="0.5", ls="--", lw=0.8)
    above.set_yscale("log")
    above.set_ylabel("divergence from the\nframe before [nats]")
    below.step(frames, result["level"], where="post", lw=1.2)
    below.set_yticks(range(len(result["thresholds"]) + 1))
    below.set_ylabel("configuration")
    below.set_xlabel("frame")
    for ax in (above, below):
        _shade(ax, result["violent"])
    spec = row["spec"]
    caption(
        figure,
        f"{spec['scene']}, seed {spec['seed']}: 0 is the fast configuration; grey: violent motion; "
        "dashed: thresholds.",
    )
    return save(figure, out / "time_line.png")


def _shade(ax: Axes, violent: Sequence[bool]) -> None:
    """Grey where motion is violent."""
    borders = np.flatnonzero(np.diff([0, *map(int, violent), 0]))
    for start, end in borders.reshape(-1, 2):
        ax.axvspan(start - 0.5, end - 0.5, color="0.9", lw=0)
