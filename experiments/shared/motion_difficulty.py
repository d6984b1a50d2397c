"""What the rows of the difficulty experiment say: means, the paper's order, correlations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ms_slam_env.evaluation.image_motion import MOTIONS
from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import rank_correlation
from ms_slam_env.report.tables import finished, flattened, grouped

Line = dict[str, Any]

HARD, EASY = ("lr_kt2", "lr_kt3"), ("lr_kt0", "lr_kt1")
"""What the paper finds: every motion of the first pair harder than every one of the second."""
STATISTICS = tuple(
    f"divergence_{name}"
    for name in ("max", "mean", "variance", "std", "max_per_s", "mean_per_s", "std_per_s")
)
ORDERED = ("max", "mean", "std")
SEEN = ("contrast", "depth_m")
CORRELATIONS = ("turn_correlation", "speed_correlation", "image_motion_correlation")
"""Of the divergence with each of ``MOTIONS``."""
WHERE = ("scene", "noise", "histograms", "divergence")


def statistics(rows: Sequence[Row]) -> list[Line]:
    """Of every motion in a scene, histogram and kind: means over its places.

    Of a motion that was also recorded there is a second line, over as many frames as that.
    """
    fields = (*WHERE, "motion")
    keys = (*STATISTICS, *MOTIONS, *SEEN)
    return [
        {
            **dict(zip(fields, group, strict=True)),
            **{key: float(np.mean([line[key] for line in lines])) for key in keys},
            "frames": lines[0]["frames"],
            "places": len(lines),
        }
        for group, lines in grouped(_lines(rows), fields).items()
    ]


def judgements(rows: Sequence[Row]) -> list[Line]:
    """Of every scene, histogram and kind: whether the paper's order holds, and correlations.

    ``pairs_max``, ``pairs_mean``, ``pairs_std``: of the four pairs of a motion that the paper finds
    hard and one that it finds easy, in how many the former has the larger statistic (means over
    the places); ``places_max`` and so on: in how many single places all four pairs hold.

    Spearman correlations of the divergence with how the camera and the image move: frame by frame
    within one motion at one place, the median over motions and places; and ``motions_...``, of the
    motions' means over all places of a scene.
    """
    lines = _lines([row for row in rows if not row["spec"]["first"]])
    found = []
    for where in grouped(lines, WHERE):
        own = [line for line in lines if tuple(map(line["spec"].get, WHERE)) == where]
        by_motion = {motion: them for (motion,), them in grouped(own, ("motion",)).items()}
        known = set(HARD + EASY) <= set(by_motion)
        found.append({
            **dict(zip(WHERE, where, strict=True)),
            **(_order(by_motion) if known else {}),
            **_correlations(by_motion),
        })  # fmt: skip
    return found


def _order(by_motion: Mapping[str, Sequence[Mapping[str, Any]]]) -> Line:
    found: Line = {"places": min(map(len, by_motion.values()))}
    for name in ORDERED:
        values = {
            motion: np.array([line[f"divergence_{name}"] for line in by_motion[motion]])
            for motion in HARD + EASY
        }
        pairs = [(values[hard], values[easy]) for hard in HARD for easy in EASY]
        found[f"pairs_{name}"] = sum(int(h.mean() > e.mean()) for h, e in pairs)
        found[f"places_{name}"] = int(np.all([h > e for h, e in pairs], axis=0).sum())
    return found


def _correlations(by_motion: Mapping[str, Sequence[Mapping[str, Any]]]) -> Line:
    found: Line = {}
    for motion, key in zip(MOTIONS, CORRELATIONS, strict=True):
        single = [line[key] for lines in by_motion.values() for line in lines]
        found[key] = None if None in single else float(np.median(single))
        means = [
            [np.mean([line[name] for line in lines]) for name in ("divergence_mean", motion)]
            for lines in by_motion.values()
        ]
        if len(means) > 2:
            found[f"motions_{key}"] = rank_correlation(*np.array(means).T)
    return found


def _lines(rows: Sequence[Row]) -> list[Row]:
    """A row for each histogram and kind of each finished row, with what those have in common."""
    lines: list[Row] = []
    for row in finished(rows):
        spec, result = row["spec"], row["result"]
        cut = f", first {spec['first']} frames" if spec["first"] else ""
        named = {"scene": Path(spec["scene"]).stem, "motion": spec["motion"] + cut}
        shared = {key: result[key] for key in ("frames", *MOTIONS, *SEEN)}
        lines += [
            {
                "spec": {**line["spec"], **named},
                "result": {**shared, **line["result"]},
                "error": None,
            }
            for line in flattened([row], "statistics")
        ]
    return lines
