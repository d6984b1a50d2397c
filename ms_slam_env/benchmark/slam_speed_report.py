"""Table and figure of the speed measurement of the surfel SLAM."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.benchmark.figures import caption, colour, new_figure, save
from ms_slam_env.report.tables import format_number, markdown_table

REST = "rest"
_BLOCK = ("version", "size", "target")


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each (size, stored surfels, version): medians over the repeats.

    ``median_ms`` is the median frame, ``mean_ms`` the mean one, which holds the rare dear frames
    too; ``stages_ms`` are means. ``ratio`` is the mean frame of version "this" over that of
    "other", the median over the rounds; ``same_estimates`` says whether the two found bit for bit
    the same poses. Both None without another version.
    """
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in _BLOCK), []).append(row)
    summary = []
    for (version, size, target), group in groups.items():
        stages = {
            stage: float(np.median([np.mean(row["stages_ms"][stage]) for row in group]))
            for stage in group[0]["stages_ms"]
        }
        mean = float(np.median([np.mean(row["frame_ms"]) for row in group]))
        other = groups.get(("other", size, target)) if version == "this" else None
        ratio = None
        if other:
            pairs = zip(group, other, strict=True)
            ratio = float(np.median([_mean(a) / _mean(b) for a, b in pairs]))
        summary.append(
            {
                "size": size,
                "target": target,
                "surfels": round(group[0]["surfels"]),
                "version": version,
                "median_ms": float(np.median([np.median(row["frame_ms"]) for row in group])),
                "mean_ms": mean,
                "stages_ms": {**stages, REST: mean - sum(stages.values())},
                "lost_frames": group[0]["lost_frames"],
                "ratio": ratio,
                "same_estimates": other and group[0]["estimates"] == other[0]["estimates"],
            }
        )
    return sorted(summary, key=lambda row: (_pixels(row["size"]), row["target"], row["version"]))


def _mean(row: dict[str, Any]) -> float:
    return float(np.mean(row["frame_ms"]))


def _pixels(size: str) -> int:
    width, _, height = size.partition("x")
    return int(width) * int(height)


def markdown_report(summary: Sequence[dict[str, Any]]) -> str:
    """The table: milliseconds of processor time a frame."""
    stages = list(summary[0]["stages_ms"])
    compared = any(row["ratio"] is not None for row in summary)
    header = ["size", "surfels stored", "median ms", "mean ms", *stages, "lost frames"]
    if compared:
        header = [*header[:2], "version", *header[2:], "ratio", "same poses"]
    lines = []
    for row in summary:
        cells = [row["size"], str(row["surfels"])]
        if compared:
            cells.append(row["version"])
        cells += [format_number(row[key], 3) for key in ("median_ms", "mean_ms")]
        cells += [f"{row['stages_ms'][stage]:.2f}" for stage in stages]
        cells.append(str(row["lost_frames"]))
        if compared:
            ratio, same = row["ratio"], row["same_estimates"]
            cells.append("" if ratio is None else format_number(ratio, 3))
            cells.append("" if same is None else "yes" if same else "no")
        lines.append(cells)
    return markdown_table(header, lines)


def save_figure(summary: Sequence[dict[str, Any]], path: Path) -> Path:
    """Draw the cost against stored surfels, and against image size by stage."""
    figure = new_figure(2, width=4.2)
    left, right = figure.subplots(1, 2)
    sizes = sorted({row["size"] for row in summary}, key=_pixels)
    for index, size in enumerate(sizes):
        for version, style in (("this", "o-"), ("other", "x--")):
            rows = [row for row in summary if (row["size"], row["version"]) == (size, version)]
            if rows:
                label = size if version == "this" else f"{size}, other version"
                x, y = [row["surfels"] for row in rows], [row["mean_ms"] for row in rows]
                left.plot(x, y, style, color=colour(index), label=label)
    left.set_xscale("log")
    left.set_ylim(bottom=0)
    left.set_xlabel("surfels stored")
    left.set_ylabel("processor time [ms/frame]")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=4, fontsize="small")
    left.grid(alpha=0.3)
    smallest = [
        next(row for row in summary if (row["size"], row["version"]) == (size, "this"))
        for size in sizes
    ]
    foot = np.zeros(len(sizes))
    for index, stage in enumerate(smallest[0]["stages_ms"]):
        height = np.array([row["stages_ms"][stage] for row in smallest])
        right.bar(sizes, height, bottom=foot, label=stage, color=colour(index), width=0.6)
        foot += height
    right.set_xlabel("image size, smallest map")
    right.legend(fontsize="small")
    right.grid(axis="y", alpha=0.3)
    caption(figure, "Mean processor time of a frame on one core; bars: its stages.")
    return save(figure, path)
