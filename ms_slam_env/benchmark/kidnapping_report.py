"""Table of the kidnapping benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_slam_env.benchmark.kidnapping_scenarios import FOREIGN
from ms_slam_env.benchmark.planner_report import finished
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import Interval, median_interval, share_interval
from ms_slam_env.report.tables import format_interval, format_number, markdown_table

EVERY = "all"


@dataclass(frozen=True)
class Cell:
    """All attempts of one image size, setting and variant.

    Attributes:
        size: of the images.
        setting: kind of interruption.
        variant: of the relocalisation.
        attempts: their number.
        found: share in which the true pose was found, with its Wilson interval; of those in the
            scene that was mapped.
        wrong: share in which a wrong pose was given.
        first: median number of frames before the first pose, of the attempts that gave one.
        relocalisation_s: mean relocalisation time of those (USME equation 11), seconds.
        lost_frame_ms: median processor time of a frame before the first pose.
        black_tracked: black frames for which a pose was given, of all attempts.
    """

    size: str
    setting: str
    variant: str
    attempts: int
    found: Interval
    wrong: Interval
    first: Interval
    relocalisation_s: float
    lost_frame_ms: Interval
    black_tracked: int


def summarise(rows: Sequence[Row]) -> list[Cell]:
    """One cell for each image size, setting and variant, in the order of their appearance.

    If there are several settings, ``EVERY`` stands for all together.
    """
    cells: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    together: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in finished(rows):
        for attempt in row["result"]["attempts"]:
            size, variant = row["spec"]["size"], attempt["variant"]
            cells.setdefault((size, attempt["setting"], variant), []).append(attempt)
            together.setdefault((size, EVERY, variant), []).append(attempt)
    if len({setting for _, setting, _ in cells}) > 1:
        cells |= together
    sizes = list(dict.fromkeys(size for size, _, _ in cells))
    settings = list(dict.fromkeys(setting for _, setting, _ in cells))
    order = sorted(cells, key=lambda key: (sizes.index(key[0]), settings.index(key[1])))
    return [_cell(key, cells[key]) for key in order]


def _cell(key: tuple[str, str, str], attempts: list[dict[str, Any]]) -> Cell:
    findable = [attempt for attempt in attempts if attempt["setting"] != FOREIGN]
    given = [attempt for attempt in attempts if attempt["first"] is not None]
    seconds = [attempt["relocalisation_s"] for attempt in given]
    return Cell(
        *key,
        attempts=len(attempts),
        found=share_interval([attempt["found"] for attempt in findable]),
        wrong=share_interval([attempt["wrong"] for attempt in attempts]),
        first=median_interval([attempt["first"] for attempt in given]),
        relocalisation_s=float(np.mean(seconds)) if seconds else float("nan"),
        lost_frame_ms=median_interval([attempt["lost_frame_ms"] for attempt in attempts]),
        black_tracked=sum(attempt["black_tracked"] for attempt in attempts),
    )


def as_table(cells: Sequence[Cell]) -> str:
    """Markdown table, one line a cell."""
    return markdown_table(
        [
            "size, setting, variant",
            "attempts",
            "found [%]",
            "wrong [%]",
            "frames before the first pose",
            "relocalisation time [s]",
            "processor time of a lost frame [ms]",
            "poses in the dark",
        ],
        [
            [
                f"{cell.size} {cell.setting} {cell.variant}",
                str(cell.attempts),
                format_interval(cell.found, 100, 3),
                format_interval(cell.wrong, 100),
                format_interval(cell.first),
                format_number(cell.relocalisation_s),
                format_interval(cell.lost_frame_ms),
                str(cell.black_tracked),
            ]
            for cell in cells
        ],
    )


def about_the_maps(rows: Sequence[Row]) -> str:
    """How good the maps were, and how many were not used because a frame of theirs was lost."""
    figures = [figure for row in finished(rows) for figure in row["result"]["maps"].values()]
    used = [figure for figure in figures if not figure["lost_frames"]]
    ate = median_interval([figure["ate_m"] for figure in used])
    return (
        f"{len(used)} of {len(figures)} maps were used, the others had lost a frame; median ATE "
        f"of the used ones {format_interval(ate, 1000)} mm.\n"
    )
