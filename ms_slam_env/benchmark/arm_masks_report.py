"""Summary and tables of the mask experiment, made from its walks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.report.records import Row
from ms_slam_env.report.statistics import Interval, bootstrap_interval, share_interval
from ms_slam_env.report.tables import format_interval, format_number, markdown_table
from ms_slam_env.robot.arm.feasibility import REASONS

EVERYWHERE = "all"
ALLOWED = REASONS[0]

Summary = dict[str, Any]
Columns = dict[str, NDArray[Any]]


def summarise(rows: Sequence[Row]) -> Summary:
    """Numbers of the report from finished walks.

    A motion is *possible* if the arm says it made it and the truth finds that it touched nothing;
    the mask is right if it allows exactly the possible ones.
    """
    places = list(dict.fromkeys(row["spec"]["scene"] for row in rows))
    by_place = {place: [row for row in rows if row["spec"]["scene"] == place] for place in places}
    if len(places) > 1:
        by_place[EVERYWHERE] = list(rows)
    cases = _joined(rows, "cases")
    return {
        "masks": {place: _mask(of_place) for place, of_place in by_place.items()},
        "reasons": _reasons(cases),
        "wrongly_allowed": _wrongly_allowed(cases),
        "errors": _errors(cases, _joined(rows, "states")),
        "sees_itself": asdict(share_interval(_joined(rows, "states")["sees_itself"])),
    }


def _joined(rows: Sequence[Row], part: str) -> Columns:
    columns = [row["result"][part] for row in rows]
    return {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}


def _possible(cases: Columns) -> NDArray[np.bool_]:
    return np.asarray(cases["reached"] & (cases["gap_m"] > 0) & ~cases["touches_itself"])


def _mask(rows: Sequence[Row]) -> Summary:
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
    return {
        "walks": len(rows),
        "cases": len(allowed),
        "allowed": asdict(share_interval(allowed)),
        "right": asdict(share_interval(allowed == possible)),
        "right_over_walks": asdict(walks),
        "wrong_of_allowed": asdict(share_interval(~possible[allowed])),
        "wrong_of_forbidden": asdict(share_interval(possible[~allowed])),
    }


def _reasons(cases: Columns) -> Summary:
    """By what the mask says: how many, and the share that was right."""
    possible = _possible(cases)
    result = {}
    for reason in REASONS:
        said = cases["reason"] == reason
        if said.any():
            right = possible[said] == (reason == ALLOWED)
            result[reason] = {"cases": int(said.sum()), "right": asdict(share_interval(right))}
    return result


def _wrongly_allowed(cases: Columns) -> dict[str, int]:
    """Why motions that the mask allowed were not possible; one motion can have several causes."""
    allowed = cases["reason"] == ALLOWED
    reached, stopped = cases["reached"], cases["stopped"]
    return {
        "not followed": int((allowed & ~reached & ~stopped).sum()),
        "protective stop": int((allowed & stopped).sum()),
        "touched furniture": int((allowed & (cases["gap_m"] <= 0)).sum()),
        "touched itself": int((allowed & cases["touches_itself"]).sum()),
    }


def _errors(cases: Columns, states: Columns) -> Summary:
    """Median and 95th percentile, in mm and degrees, with the number of values."""
    moved = (cases["reason"] == ALLOWED) & cases["reached"] & (cases["action"] > 0)
    values = {
        "end of a motion against its command [mm]": 1e3 * cases["error_m"][moved],
        "end of a motion against its command [deg]": np.degrees(cases["error_rad"][moved]),
        "camera below its command at rest (sag) [mm]": 1e3 * states["sag_m"],
        "camera from its command at rest [mm]": 1e3 * states["offset_m"],
        "kinematic pose from the true one [mm]": 1e3 * states["kinematic_m"],
        "kinematic pose from the true one [deg]": np.degrees(states["kinematic_rad"]),
        "least gap to furniture, allowed motions [mm]": 1e3 * cases["gap_m"][moved],
    }
    return {
        name: {
            "count": len(v),
            "least": float(np.min(v, initial=np.inf)),
            "median": float(np.median(v)) if len(v) else float("nan"),
            "p95": float(np.percentile(v, 95)) if len(v) else float("nan"),
        }
        for name, v in values.items()
    }


def as_markdown(summary: Summary) -> str:
    """Three tables."""

    def share(interval: dict[str, float], digits: int = 3) -> str:
        return format_interval(Interval(**interval), 100, digits)

    masks = markdown_table(
        [
            "scene",
            "walks",
            "motions",
            "allowed [%]",
            "mask right [%]",
            "by walks [%]",
            "wrong of allowed [%]",
            "wrong of forbidden [%]",
        ],
        [
            [
                place,
                str(cell["walks"]),
                str(cell["cases"]),
                share(cell["allowed"]),
                share(cell["right"], 4),
                share(cell["right_over_walks"], 4),
                share(cell["wrong_of_allowed"], 2),
                share(cell["wrong_of_forbidden"], 2),
            ]
            for place, cell in summary["masks"].items()
        ],
    )
    reasons = markdown_table(
        ["the mask says", "motions", "right [%]"],
        [
            [reason, str(cell["cases"]), share(cell["right"], 4)]
            for reason, cell in summary["reasons"].items()
        ],
    )
    causes = ", ".join(f"{name} {count}" for name, count in summary["wrongly_allowed"].items())
    errors = markdown_table(
        ["error", "values", "least", "median", "95 %"],
        [
            [name, str(cell["count"])]
            + [format_number(cell[key], 2) for key in ("least", "median", "p95")]
            for name, cell in summary["errors"].items()
        ],
    )
    return (
        f"{masks}\n{reasons}\nCauses where it allowed wrongly: {causes}.\n\n{errors}\n"
        f"The arm is in its own camera's view at {share(summary['sees_itself'], 2)} % of stops.\n"
        "Shares with 95 % Wilson intervals, as if motions were independent; `by walks` resamples "
        "whole walks instead.\n"
    )
