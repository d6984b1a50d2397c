"""Tables of the experiment on the arm's masks, made from its walks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.report.statistics import bootstrap_interval, share_interval
from ms_slam_env.report.tables import Column, Row, Table, finished, make_table
from ms_slam_env.robot.arm.feasibility import REASONS

EVERYWHERE = "all"
ALLOWED = REASONS[0]
MASK = (
    "mask_allows",
    "mask_right",
    "mask_right_by_walks",
    "wrong_of_allowed",
    "wrong_of_forbidden",
)
MOVED = {
    "end of a motion against its command": ("error_m", "error_rad"),
    "least gap to furniture": ("gap_m",),
}
AT_REST = {
    "camera below its command at rest (sag)": ("sag_m",),
    "camera from its command at rest": ("offset_at_rest_m",),
    "kinematic pose from the true one": ("kinematic_m", "kinematic_rad"),
}
"""What is measured of motions that were allowed and made, and of stops: columns of a walk."""

Columns = Mapping[str, NDArray[Any]]


def mask_tables(rows: Sequence[Row]) -> list[Table]:
    """By scene, by reason, causes where it allowed wrongly, errors."""
    walks = finished(rows)
    places = {place: [row for row in walks if row["spec"]["scene"] == place]
              for place in dict.fromkeys(row["spec"]["scene"] for row in walks)}  # fmt: skip
    if len(places) > 1:
        places[EVERYWHERE] = walks
    cases, stops = _joined(walks, "cases"), _joined(walks, "stops")
    seen = share_interval(stops["sees_itself"])
    lines = [{"scene": place, **_mask(of)} for place, of in places.items()]
    note = (
        "Shares with 95 % Wilson intervals, as if motions were independent; by walks: whole walks "
        f"resampled. The arm is in its own camera's view at {100 * seen.value:.2g} % of stops."
    )
    return [
        make_table(["scene", "walks", "motions", *MASK], lines, note=note),
        make_table(["reason", "motions", "mask_right"], _reasons(cases), "By what the mask says"),
        make_table(["cause", "motions"], _causes(cases), "Where it allowed wrongly"),
        _errors(cases, stops),
    ]


def _joined(rows: Sequence[Row], part: str) -> Columns:
    columns = [row["result"][part] for row in rows]
    return {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}


def _possible(cases: Columns) -> NDArray[np.bool_]:
    return np.asarray(cases["reached"] & (cases["gap_m"] > 0) & ~cases["touches_itself"])


def _mask(rows: Sequence[Row]) -> dict[str, Any]:
    cases = _joined(rows, "cases")
    allowed, possible = cases["reason"] == ALLOWED, _possible(cases)
    right, total = [], []
    for row in rows:
        walk = _joined([row], "cases")
        agrees = (walk["reason"] == ALLOWED) == _possible(walk)
        right.append(int(agrees.sum()))
        total.append(len(agrees))
    walks = bootstrap_interval(
        (right, total), lambda a, b, axis: np.sum(a, axis=axis) / np.sum(b, axis=axis)
    )
    shares = (
        share_interval(allowed),
        share_interval(allowed == possible),
        walks,
        share_interval(~possible[allowed]),
        share_interval(possible[~allowed]),
    )
    return {"walks": len(rows), "motions": len(allowed), **dict(zip(MASK, shares, strict=True))}


def _reasons(cases: Columns) -> list[dict[str, Any]]:
    """By what the mask says: how many, and the share that was right."""
    possible, lines = _possible(cases), []
    for reason in REASONS:
        said = cases["reason"] == reason
        if said.any():
            right = share_interval(possible[said] == (reason == ALLOWED))
            lines.append({"reason": reason, "motions": int(said.sum()), "mask_right": right})
    return lines


def _causes(cases: Columns) -> list[dict[str, Any]]:
    """Why motions that the mask allowed were not possible; one motion can have several causes."""
    allowed, stopped = cases["reason"] == ALLOWED, cases["stopped"]
    causes = {
        "not followed": ~cases["reached"] & ~stopped,
        "protective stop": stopped,
        "touched furniture": cases["gap_m"] <= 0,
        "touched itself": cases["touches_itself"],
    }
    return [{"cause": name, "motions": int((allowed & of).sum())} for name, of in causes.items()]


def _errors(cases: Columns, stops: Columns) -> Table:
    """Least, median and 95th percentile; lengths and angles of one thing on one line."""
    moved = (cases["reason"] == ALLOWED) & cases["reached"] & (cases["action"] > 0)
    lines = []
    for columns, kinds in (({n: c[moved] for n, c in cases.items()}, MOVED), (stops, AT_REST)):
        for name, keys in kinds.items():
            line: dict[str, Any] = {"error_kind": name, "values": len(columns[keys[0]])}
            for key in keys:
                unit = key.rpartition("_")[2]
                line |= {f"{s}_{unit}": value for s, value in _spread(columns[key]).items()}
            lines.append(line)
    statistics = {"least": "least", "median": "median", "p95": "95 %"}
    shown = [
        Column(f"{name}_{unit}", f"arm_error_{unit}", heading)
        for unit in ("m", "rad")
        for name, heading in statistics.items()
    ]
    return make_table(["error_kind", "values", *shown], lines, "Errors of the arm")


def _spread(values: NDArray[np.float64]) -> dict[str, float]:
    """Least, median and 95th percentile."""
    if not len(values):
        return dict.fromkeys(("least", "median", "p95"), float("nan"))
    least, median, p95 = np.percentile(values, [0, 50, 95])
    return {"least": float(least), "median": float(median), "p95": float(p95)}
