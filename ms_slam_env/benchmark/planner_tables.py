"""Tables that compare planners: pooled losses, and aggregates across scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark.episodes import short_planner_names
from ms_slam_env.env.planners import is_privileged
from ms_slam_env.report import statistics
from ms_slam_env.report.tables import (
    Column,
    Row,
    Table,
    complete_cases,
    finished,
    grouped,
    make_table,
)

PAIRS = {
    "f_score_5cm": "Share of pairs, by final F-score",
    "f_score_5cm_area": "Share of pairs, by area under the F-score",
    "return": "Share of pairs, by return",
}
"""Metrics that planners are compared by, and the titles of the tables of every two planners."""
PRIVILEGED = "privileged"
"""Column of whether a planner sees the truth."""
RANKED_BY = "f_score_5cm"
"""A camera that stands still loses recall, one that gets lost loses precision."""
HEADLINE = (
    *("f_score_5cm", "f_score_5cm_area", "f_score_2cm", "rcm", "ate_m", "ate_tracked_m"),
    *("tracked_share", "lost", "violations", "path_length_m", "energy_j", "decision_ms"),
)
DETAILS = ("ate_max_m", "rpe_m", "rer_m", "mapped_area_m2", "M_I", "M_D", "return")


def with_losses(table: Table, rows: Sequence[Row]) -> Table:
    """Add each planner's total losses and share of losses not recovered to a table.

    The energy column is dropped if no energy was used. Older results have no counts of losses.
    """
    results = grouped(rows, ("planner",))
    lines = []
    for line in table.rows:
        counted = [result for result in results[(line["planner"],)] if "losses" in result]
        losses = sum(result["losses"] for result in counted)
        for_good = sum(result["losses_not_recovered"] for result in counted)
        share = statistics.share_interval(np.arange(losses) < for_good)
        total = losses if counted else None
        lines.append({**line, "losses": total, "not_recovered_share": share})
    moved = any(result.get("energy_j") for of in results.values() for result in of)
    columns = [column for column in table.columns if moved or column.name != "energy_j"]
    after = 1 + [column.name for column in columns].index("lost")
    columns[after:after] = [Column("losses"), Column("not_recovered_share")]
    return replace(table, columns=tuple(columns), rows=tuple(lines))


def with_privilege(table: Table) -> Table:
    """Say of each planner whether it sees the truth, where one of a table's planners does."""
    names = [column.name for column in table.columns]
    if "planner" not in names or PRIVILEGED in names:
        return table
    known = [is_privileged(str(line.get("planner"))) for line in table.rows]
    if not any(known):
        return table
    after = names.index("planner") + 1
    columns = (*table.columns[:after], Column(PRIVILEGED), *table.columns[after:])
    lines = [{**line, PRIVILEGED: of} for line, of in zip(table.rows, known, strict=True)]
    return replace(table, columns=columns, rows=tuple(lines))


def score_matrices(rows: Sequence[Row], metric: str = RANKED_BY) -> dict[str, NDArray[np.float64]]:
    """Return the scores (episodes, scenes) of each planner with an episode in every scene.

    Scenes with more finished episodes than the others lose the surplus.
    """
    scenes = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    matrices = {}
    for planner in dict.fromkeys(map(_planner, rows)):
        columns: list[list[float]] = [
            [
                row["result"][metric]
                for row in finished(rows)
                if (_planner(row), row["spec"]["scene"]) == (planner, scene)
                and metric in row["result"]  # older results have no area
            ]
            for scene in scenes
        ]
        count = min(map(len, columns))
        if count:
            matrices[planner] = np.array([column[:count] for column in columns]).T
    return matrices


def across_scenes(rows: Sequence[Row], title: str = "") -> list[Table]:
    """Tabulate the interquartile means, best planner first."""
    scores = score_matrices(rows)
    if not scores:
        return []
    means = statistics.interquartile_means(scores)
    lines: list[dict[str, Any]] = [
        {"planner": name, "f_score_5cm_iqm": means[name]}
        for name in _ranked({name: of.value for name, of in means.items()})
    ]
    return [make_table(["planner", "f_score_5cm_iqm"], lines, title)]


COMPARED = {
    RANKED_BY: "better F-score",
    "f_score_5cm_area": "larger area under F-score over steps",
    "return": "larger return",
}
"""Metrics by which planners are compared pairwise, and the wording of the tables' notes."""


def better_than_each_other(
    rows: Sequence[Row], prefix: str = "", metric: str = RANKED_BY
) -> list[Table]:
    """Tabulate the probability that a row's planner scores better than a column's.

    Empty for a single planner.
    """
    title, what = PAIRS[metric], COMPARED[metric]
    scores = score_matrices(rows, metric)
    if len(scores) < 2:
        return []
    ranked = _best_first(scores)
    note = f"Probability that a line's planner has the {what}, with 95 % intervals."
    return [_two_by_two(ranked, statistics.improvement_matrix(ranked), prefix + title, note)]


def trainings_compared(
    rows: Sequence[Row], prefix: str = "", metric: str = RANKED_BY
) -> list[Table]:
    """Make ``better_than_each_other`` for trainings, whose policies are also resampled.

    Empty for a single training or planner.
    """
    title, what = PAIRS[metric], COMPARED[metric]
    name_of = _names_of_trainings(rows)
    members: dict[str, list[NDArray[np.float64]]] = {}
    for planner, of in score_matrices(rows, metric).items():
        members.setdefault(name_of[planner], []).append(of)
    if len(members) < 2:
        return []
    scores = {
        name: np.stack([of[: min(map(len, policies))] for of in policies])
        for name, policies in members.items()
    }
    ranked = _best_first(scores)
    note = (
        f"Probability that a line's planner has the {what}, with 95 % intervals over episodes "
        "and, of several policies, over these."
    )
    return [_two_by_two(ranked, statistics.improvement_of_trainings(ranked), prefix + title, note)]


def _best_first(scores: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    means = {
        name: float(statistics.interquartile_mean(of.reshape(-1))) for name, of in scores.items()
    }
    return {name: scores[name] for name in _ranked(means)}


def _two_by_two(
    names: Iterable[str],
    pairs: Mapping[tuple[str, str], statistics.Interval],
    title: str,
    note: str,
) -> Table:
    """Make a table with a row and a column for each planner, in this order."""
    names = tuple(names)
    label = short_planner_names(names)
    columns = [Column(name, "improvement", label[name]) for name in names]
    lines: list[dict[str, Any]] = [
        {"planner": name, **{other: pairs.get((name, other)) for other in names}} for name in names
    ]
    return make_table(["planner", *columns], lines, title, note)


FROM_STARTS = {
    "f_score_5cm_area": ("area under the F-score", "area under F-score over steps", "sooner_share"),
    "return": ("return", "return", "richer_share"),
}
"""Metrics compared start by start: name in a title and in a note, and metric of the shares."""


def from_the_same_start(
    rows: Sequence[Row], prefix: str = "", metric: str = "f_score_5cm_area"
) -> list[Table]:
    """Tabulate the share of starts from which a row's planner has a larger area than a column's.

    This separates planners where each seed makes another place, as in `home`: there the areas
    differ more between places than between planners. Only starts that every planner finished
    count and, for a pair of planners, only those with different areas. Empty for a single planner.
    The same of another ``metric`` of FROM_STARTS.
    """
    by, what, shown = FROM_STARTS[metric]
    known = [row for row in finished(rows) if metric in row["result"]]  # older ones have no area
    pairs = complete_cases(known, ("scene", "seed"), "planner")
    pairs.sort(key=lambda row: (row["spec"]["scene"], row["spec"]["seed"]))
    results = {name: of for (name,), of in grouped(pairs, ("planner",)).items()}
    if len(results) < 2:
        return []
    values = {name: np.array([result[metric] for result in of]) for name, of in results.items()}
    names = sorted(values, key=lambda name: -float(np.median(values[name])))
    label, count = short_planner_names(names), len(values[names[0]])

    def share(one: str, other: str) -> statistics.Interval | None:
        more = np.sign(values[one] - values[other])
        return statistics.share_interval(more[more != 0] > 0) if more.any() else None

    lines = [{"planner": one, **{other: share(one, other) for other in names}} for one in names]
    columns = [Column(name, shown, label[name]) for name in names]
    note = (
        f"Share of {count} starts from which a line's planner has the larger {what} than a "
        "column's, with 95 % Wilson intervals."
    )
    title = f"{prefix}Share of starts, by {by}"
    return [make_table(["planner", *columns], lines, title, note)]


def policies_together(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Merge planners that differ only in ``path`` into one; empty if there are none.

    This pools the policies of one training, each trained with another seed. Files in different
    folders belong to different trainings; for a file alone in its folder, as a training leaves it,
    the parent of that folder counts.
    """
    names = _names_of_trainings(rows)
    if all(name == planner for planner, name in names.items()):
        return []
    return [{**row, "spec": {**row["spec"], "planner": names[_planner(row)]}} for row in rows]


def _names_of_trainings(rows: Sequence[Row]) -> dict[str, str]:
    """Map each planner to its name in ``policies_together``; unmerged planners keep theirs."""
    members: dict[str, list[str]] = {}
    for planner in dict.fromkeys(map(_planner, rows)):
        members.setdefault(_without_path(planner)[0], []).append(planner)
    trainings: dict[str, list[str]] = {}
    for name, of in members.items():
        paths = {planner: _without_path(planner)[1] for planner in of}
        files = Counter(path.parent for path in paths.values() if path)
        folders = {
            planner: path and (path.parent if files[path.parent] > 1 else path.parent.parent)
            for planner, path in paths.items()
        }
        several = len(set(folders.values()) - {None}) > 1
        for planner, folder in folders.items():
            training = f"{name},path={folder}" if several and folder else name
            trainings.setdefault(training, []).append(planner)
    return {
        planner: f"{name} ({len(of)} policies)" if len(of) > 1 else planner
        for name, of in trainings.items()
        for planner in of
    }


def _without_path(planner: str) -> tuple[str, PurePosixPath | None]:
    """Split a planner into its text without the option ``path``, and that path or None."""
    parts = planner.split(",")
    paths = [PurePosixPath(part[5:]) for part in parts if part.startswith("path=")]
    rest = [part for part in parts if not part.startswith("path=")]
    return ",".join(rest), paths[0] if paths else None


def _ranked(means: Mapping[str, float]) -> list[str]:
    return sorted(means, key=lambda name: -means[name])


def _planner(row: Mapping[str, Any]) -> str:
    return str(row["spec"]["planner"])
