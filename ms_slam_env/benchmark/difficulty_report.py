"""What came of the difficulty experiment: table, order of the motions, reasons, figures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from ms_slam_env.benchmark import figures
from ms_slam_env.benchmark.image_motion import MOTIONS
from ms_slam_env.evaluation.sequence_divergence import KINDS, statistics_of
from ms_slam_env.report.records import Row
from ms_slam_env.report.tables import format_number, markdown_table

Float64 = NDArray[np.float64]
Found = list[dict[str, Any]]

HARD, EASY = ("lr_kt2", "lr_kt3"), ("lr_kt0", "lr_kt1")
"""What the paper finds: every motion of the first pair harder than every one of the second."""

PAPER = {
    "lr_kt0": (0.0250, 0.0026, 0.0014),
    "lr_kt1": (0.0183, 0.0026, 0.0012),
    "lr_kt2": (0.0427, 0.0032, 0.0023),
    "lr_kt3": (0.0352, 0.0032, 0.0023),
}
"""Table I of the paper: max, mean and "variance" of the intensity divergence."""

RECORDING = "recorded depth"
"""Scene of a row that was recorded, not rendered."""

_STATISTICS = ("max", "mean", "variance", "std", "max_per_s", "mean_per_s", "std_per_s")
_SMOOTH_S = 1.0  # window of the lines in the figure


def statistics(rows: Sequence[Row]) -> Found:
    """Of every motion in a scene, setting and kind: the statistics, averaged over its places.

    ``places`` tells over how many; the quantities in ``MOTIONS``, ``contrast`` and ``depth_m``
    are averaged likewise. Of a motion that was also recorded there is a second entry, over as many
    frames as the recording has.
    """
    found = []
    for (scene, noise, motion), group in _by_sequence([*rows, *_as_recorded(rows)]).items():
        results = [row["result"] for row in group]
        moving = {name: _mean([np.mean(r["motion"][name]) for r in results]) for name in MOTIONS}
        seen = {name: _mean([r[name] for r in results]) for name in ("contrast", "depth_m")}
        for setting, (column, kind) in product(results[0]["divergences"], enumerate(KINDS)):
            values = [
                statistics_of(_values(r, setting, column), np.array(r["gaps_s"])) for r in results
            ]
            if values[0]["max"] is None:
                continue
            found.append(
                {
                    **{"scene": scene, "noise": noise, "motion": motion},
                    **{"setting": setting, "divergence": kind},
                    **{name: _mean([v[name] for v in values]) for name in values[0]},
                    **moving,
                    **seen,
                    "frames": len(results[0]["times_s"]) + 1,
                    "places": len(results),
                }
            )
    return found


def order(rows: Sequence[Row]) -> Found:
    """Whether the paper's order holds, of every scene, setting and kind.

    ``pairs_max``, ``pairs_mean``, ``pairs_std``: of the four pairs of a motion that the paper finds
    hard and one that it finds easy, in how many the former has the larger statistic (means over
    the places); ``places_max`` and so on: in how many single places all four pairs hold.
    """
    grouped: dict[tuple[str, ...], dict[str, list[dict[str, float | None]]]] = {}
    for (scene, noise, motion), group in _by_sequence(rows).items():
        for row in group:
            result = row["result"]
            for setting, (column, kind) in product(result["divergences"], enumerate(KINDS)):
                numbers = statistics_of(
                    _values(result, setting, column), np.array(result["gaps_s"])
                )
                key = (scene, noise, setting, kind)
                grouped.setdefault(key, {}).setdefault(motion, []).append(numbers)
    found = []
    for (scene, noise, setting, kind), by_motion in grouped.items():
        if not set(HARD + EASY) <= set(by_motion):
            continue
        entry: dict[str, Any] = {
            **{"scene": scene, "noise": noise, "setting": setting, "divergence": kind},
            "places": min(len(places) for places in by_motion.values()),
        }
        for name in ("max", "mean", "std"):
            values = {m: np.array([p[name] for p in by_motion[m]]) for m in HARD + EASY}
            pairs = [(values[h], values[e]) for h in HARD for e in EASY]
            entry[f"pairs_{name}"] = sum(int(h.mean() > e.mean()) for h, e in pairs)
            entry[f"places_{name}"] = int(np.all([h > e for h, e in pairs], axis=0).sum())
        found.append(entry)
    return found


def correlations(rows: Sequence[Row]) -> Found:
    """Spearman correlation of the divergence with how the camera and the image move.

    Frame by frame within one motion at one place, ``frames_...`` the median over motions and
    places; and ``motions_...``, of the motions' means over all places of a scene.
    """
    found = []
    scenes = dict.fromkeys((row["spec"]["scene"], row["spec"]["noise"]) for row in rows)
    for scene, noise in scenes:
        results = [
            (row["spec"]["motion"], row["result"])
            for row in rows
            if (row["spec"]["scene"], row["spec"]["noise"]) == (scene, noise)
        ]
        for setting, (column, kind) in product(results[0][1]["divergences"], enumerate(KINDS)):
            entry: dict[str, Any] = {
                **{"scene": scene, "noise": noise, "setting": setting, "divergence": kind}
            }
            if np.isnan(_values(results[0][1], setting, column)).all():
                continue
            names = dict.fromkeys(motion for motion, _ in results)
            for name in MOTIONS:
                single = [
                    _rank_correlation(_values(r, setting, column), np.array(r["motion"][name]))
                    for _, r in results
                ]
                entry[f"frames_{name}"] = float(np.median(single))
                of_motions = [[r for motion, r in results if motion == wanted] for wanted in names]
                means = np.array(
                    [
                        [
                            np.mean([np.mean(_values(r, setting, column)) for r in group]),
                            np.mean([np.mean(r["motion"][name]) for r in group]),
                        ]
                        for group in of_motions
                    ]
                )
                enough = len(names) > 2
                entry[f"motions_{name}"] = _rank_correlation(*means.T) if enough else None
            found.append(entry)
    return found


def as_markdown(statistics: Found, order: Found, correlation: Found) -> str:
    """All tables."""
    names = {s["scene"]: Path(s["scene"]).stem for s in statistics}
    which = ("scene", "noise", "motion")
    shown = (*which, "setting", "divergence", *_STATISTICS, "frames", "places")
    parts = ["Statistics of the divergence (nats; rates nats/s), means over the places\n"]
    parts.append(_table(statistics, shown, names))
    parts.append("How the camera and its image move, and what it sees\n")
    once = {tuple(entry[name] for name in which): entry for entry in statistics}
    parts.append(_table(list(once.values()), (*which, *MOTIONS, "contrast", "depth_m"), names))
    paper = [[m, *(f"{v:.4f}" for v in numbers)] for m, numbers in PAPER.items()]
    parts.append("The paper's Table I (intensity)\n")
    parts.append(markdown_table(["motion", "max", "mean", '"variance"'], paper))
    parts.append("Order: pairs of 4 in which kt2 or kt3 exceeds kt0 or kt1; places with all 4\n")
    parts.append(_table(order, tuple(order[0]) if order else (), names))
    parts.append("Spearman correlation with the motion, by frame and by motion\n")
    parts.append(_table(correlation, tuple(correlation[0]) if correlation else (), names))
    return "\n".join(parts)


def save_figures(rows: Sequence[Row], out: Path) -> list[Path]:
    """Divergence per second over time, a file for each scene and setting, a line for each motion.

    Drawn is the mean over a second, of the first place.
    """
    paths = []
    grouped: dict[tuple[str, str], list[Row]] = {}
    for (scene, noise, _), group in _by_sequence(rows).items():
        grouped.setdefault((scene, noise), []).append(group[0])
    for (scene, noise), group in grouped.items():
        for setting in group[0]["result"]["divergences"]:
            columns = [
                k
                for k in range(len(KINDS))
                if not np.isnan(_values(group[0]["result"], setting, k)[0])
            ]
            figure = figures.new_figure(len(columns), 5.0)
            axes = figure.subplots(1, len(columns), squeeze=False)[0]
            for column, ax in zip(columns, axes, strict=True):
                for index, row in enumerate(group):
                    result = row["result"]
                    rate = _smooth(
                        _values(result, setting, column), np.array(result["gaps_s"]), _SMOOTH_S
                    )
                    colour, motion = figures.colour(index), row["spec"]["motion"]
                    ax.plot(result["times_s"], rate, color=colour, linewidth=1.0, label=motion)
                ax.set(
                    xlabel="time [s]", ylabel=f"{KINDS[column]} divergence [nats/s]", ylim=(0, None)
                )
                ax.grid(alpha=0.3)
            figures.legend_beside(figure, axes[0])
            name = Path(scene).stem.replace(" ", "_")
            figures.caption(figure, f"{name}, noise {noise}, setting {setting}: means over 1 s.")
            file = f"{name}_{noise}_{setting}.png"
            paths.append(figures.save(figure, out / file))
    return paths


def _by_sequence(rows: Sequence[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Rows of all places by scene, noise and motion."""
    grouped: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        spec = row["spec"]
        grouped.setdefault((spec["scene"], spec["noise"], spec["motion"]), []).append(row)
    return grouped


def _as_recorded(rows: Sequence[Row]) -> list[Row]:
    """Rows of the motions that were recorded too, cut to the recording's length."""
    recorded = {
        row["spec"]["motion"]: len(row["result"]["gaps_s"])
        for row in rows
        if row["spec"]["scene"] == RECORDING
    }
    cut_rows = []
    for row in rows:
        spec, result = row["spec"], row["result"]
        count = recorded.get(spec["motion"], len(result["gaps_s"]))
        if spec["scene"] == RECORDING or count >= len(result["gaps_s"]):
            continue
        cut = {
            **result,
            **{name: result[name][:count] for name in ("times_s", "gaps_s")},
            "divergences": {k: v[:count] for k, v in result["divergences"].items()},
            "motion": {k: v[:count] for k, v in result["motion"].items()},
        }
        motion = f"{spec['motion']}, first {count + 1} frames"
        cut_rows.append({"spec": {**spec, "motion": motion}, "result": cut})
    return cut_rows


def _values(result: dict[str, Any], setting: str, column: int) -> Float64:
    """Divergences (T,) of one kind; NaN where there are none."""
    return np.array(result["divergences"][setting], dtype=np.float64)[:, column]


def _smooth(values: Float64, gaps_s: Float64, window_s: float) -> Float64:
    """Sum over a window centred on each frame, by its length: a rate (T,)."""
    width = max(1, min(len(values), round(window_s / float(np.median(gaps_s)))))
    ones = np.ones(width)
    return np.convolve(values, ones, "same") / np.convolve(gaps_s, ones, "same")


def _rank_correlation(a: Float64, b: Float64) -> float:
    """Spearman's; NaN where one of them does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(spearmanr(a, b).statistic)


def _mean(values: Sequence[Any]) -> float:
    return float(np.mean(values))


def _table(entries: Found, columns: Sequence[str], names: dict[str, str]) -> str:
    body = []
    for entry in entries:
        cells = [entry[name] for name in columns]
        texts = [
            "-"
            if c is None
            else format_number(c, 3)
            if isinstance(c, float)
            else names.get(c, str(c))
            for c in cells
        ]
        body.append(texts)
    return markdown_table([c.replace("_", " ") for c in columns], body)
