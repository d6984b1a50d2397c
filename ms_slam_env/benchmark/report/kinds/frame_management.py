"""Frame management: error and map against the share of frames processed."""

from __future__ import annotations

from typing import Any

from ms_slam_env.benchmark.report.bars import bar_figure
from ms_slam_env.benchmark.report.blocks import Figure
from ms_slam_env.benchmark.report.curves import curve_figure
from ms_slam_env.benchmark.report.discovery import Result
from ms_slam_env.benchmark.report.flatten import Record, flatten, number
from ms_slam_env.benchmark.report.kinds.base import Kind

_MEASURES = ("ate_m", "ate_processed_m", "f_2cm", "f_5cm", "failed", "lost", "cpu_ms", "filter_ms")
_REGULAR = "regular_"


class FrameManagement(Kind):
    """Filters that drop frames, against regular skipping."""

    name = "frame management"
    about = (
        "Frames that show little new are dropped before SLAM sees them. A good filter loses less "
        "accuracy than skipping as many frames regularly."
    )

    def fits(self, content: dict[str, Any]) -> bool:
        """A summary by management with the share of frames processed."""
        summary = content.get("summary")
        return (
            isinstance(summary, list)
            and bool(summary)
            and all(isinstance(c, dict) and {"management", "processed"} <= set(c) for c in summary)
        )

    def figures(self, result: Result) -> list[Figure]:
        """Every measure over the share of frames; each filter beside regular skipping."""
        cells = [flatten(cell) for cell in result.content["summary"]]
        curves: list[Record] = []
        pairs: list[Record] = []
        for cell in cells:
            name = str(cell["management"])
            kind = name.partition(",")[0]
            curves.append(_row(kind, cell, ""))
            if f"{_REGULAR}ate_m" in cell:
                curves.append(_row(f"regular beside {kind}", cell, _REGULAR))
                pairs.append({**_row("filter", cell, ""), "management": name})
                pairs.append({**_row("regular skipping", cell, _REGULAR), "management": name})
        caption = (
            "Medians over the sequences; none: every frame; regular beside a filter: as many "
            "frames as it took, at regular intervals."
        )
        x, title = "processed_share", "Measures over the share of frames processed"
        found = [
            curve_figure(curves, x, "filter", _MEASURES, title, caption),
            bar_figure(
                pairs,
                "Filters beside regular skipping of as many frames",
                ["management", "filter"],
                _MEASURES,
            ),
        ]
        return [figure for figure in found if figure is not None]


def _row(kind: str, cell: Record, prefix: str) -> Record:
    row: Record = {"filter": kind, "processed_share": number(cell.get(f"{prefix}processed"))}
    return {**row, **{name: cell.get(f"{prefix}{name}") for name in _MEASURES}}
