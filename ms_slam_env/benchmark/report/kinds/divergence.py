"""The difficulty of sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ms_slam_env.benchmark.report import plots
from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Block, Figure, Plot
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten, table_of
from ms_slam_env.benchmark.report.kinds.base import Kind

_KINDS = ("intensity", "depth")
_MAX_POINTS = 3000


class Divergence(Kind):
    """``ms-slam divergence``: how hard sequences are."""

    name = "difficulty of sequences"
    about = (
        "How far each frame's histogram of intensity, and of depth, diverges from that of the "
        "frame before: a sequence of large divergence is hard to track (ICRA 2017, Table I)."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """Sequences with times and divergences."""
        sequences = content.get("sequences")
        return (
            isinstance(sequences, list)
            and bool(sequences)
            and all(isinstance(s, dict) and "times_s" in s and "depth" in s for s in sequences)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Divergence over time, statistics by sequence."""
        sequences = result.content["sequences"]
        found = [over_time(sequences)]
        if len(sequences) > 1:
            names = ["sequence", "divergence"]
            found.append(bar_figure(statistics_rows(sequences), "Statistics", names))
        return [figure for figure in found if figure is not None]

    def tables(self, result: Result) -> list[Block]:
        """The statistics, where no Markdown file holds them."""
        rows = statistics_rows(result.content["sequences"])
        return [] if result.texts or not rows else [table_of(rows, "Statistics")]


def over_time(sequences: Sequence[dict[str, Any]]) -> Figure | None:
    """A line for each sequence; the two kinds to choose from."""
    found = []
    for kind in _KINDS:
        data = []
        for index, sequence in enumerate(sequences):
            times, values = sequence["times_s"], sequence.get(kind) or []
            if len(values) != len(times) or all(value is None for value in values):
                continue
            every = max(1, len(times) // _MAX_POINTS)
            name = str(sequence.get("sequence", index + 1))
            trace = plots.line(name, times[::every], values[::every], index)
            trace["line"]["width"] = 1.2
            trace["hovertemplate"] = "%{x:.2f} s: %{y:.4g} nats<extra>%{fullData.name}</extra>"
            data.append(trace)
        if data:
            axes = plots.axis("time [s]"), plots.axis(f"{kind} divergence [nats]")
            found.append(Plot(f"{kind} divergence", data, plots.layout(*axes)))
    caption = "From frame to frame. Click a name to hide its line."
    return Figure("Divergence over time", caption, tuple(found[::-1])) if found else None


def statistics_rows(sequences: Sequence[dict[str, Any]]) -> list[Record]:
    """One row for each sequence and kind."""
    rows: list[Record] = []
    for sequence in sequences:
        for kind, numbers in (sequence.get("statistics") or {}).items():
            if isinstance(numbers, dict):
                head: Record = {"sequence": str(sequence.get("sequence")), "divergence": kind}
                rows.append({**head, **flatten(numbers)})
    return rows
