"""The mask experiment: its summary from cases of known content, and one real walk."""

import pytest
from ms_slam_experiments.arm_masks import mask_tables

# reason, reached, stopped, gap_m, touches_itself: right where allowed and possible agree
CASES = [
    ("ok", True, False, 0.05, False),  # right
    ("ok", True, False, 0.05, False),  # right
    ("ok", True, False, -0.01, False),  # wrong: touched furniture
    ("ok", False, True, 0.01, False),  # wrong: stopped
    ("ok", True, False, 0.05, True),  # wrong: touched itself
    ("furniture", False, False, 0.01, False),  # right
    ("furniture", True, False, -0.01, False),  # right: it went through
    ("joint limit", True, False, 0.05, False),  # wrong: it can
]
AT_REST = ("sag_m", "offset_at_rest_m", "kinematic_m", "kinematic_rad")


def row(scene, seed, cases):
    reason, reached, stopped, gap, itself = zip(*cases, strict=True)
    count = len(cases)
    return {
        "spec": {"scene": scene, "seed": seed},
        "error": None,
        "result": {
            "cases": {
                "stop": [0] * count,
                "action": list(range(1, count + 1)),
                "reason": list(reason),
                "reached": list(reached),
                "stopped": list(stopped),
                "gap_m": list(gap),
                "touches_itself": list(itself),
                "error_m": [0.001] * count,
                "error_rad": [0.01] * count,
            },
            "stops": {**{name: [0.002, 0.004] for name in AT_REST}, "sees_itself": [False, False]},
        },
    }


def test_tables():
    rows = [row("table", 1000, CASES), row("wall", 1000, CASES[:2])]
    masks, reasons, causes, errors = mask_tables(rows)
    table, wall, everywhere = masks.rows
    assert table["motions"] == 8
    assert table["mask_allows"].value == 5 / 8
    assert table["mask_right"].value == 4 / 8
    assert table["wrong_of_allowed"].value == 3 / 5
    assert table["wrong_of_forbidden"].value == 1 / 3
    assert wall["mask_right"].value == 1
    assert everywhere["mask_right"].value == 6 / 10
    by_walks = everywhere["mask_right_by_walks"]
    assert (by_walks.value, by_walks.low, by_walks.high) == (6 / 10, 0.5, 1)
    right = {line["reason"]: line["mask_right"].value for line in reasons.rows}
    assert right == {"ok": 4 / 7, "furniture": 1, "joint limit": 0}
    assert {line["cause"]: line["motions"] for line in causes.rows} == {
        "not followed": 0,
        "protective stop": 1,
        "touched furniture": 1,
        "touched itself": 1,
    }
    (sag,) = [line for line in errors.rows if "sag" in line["error_kind"]]
    assert (sag["values"], sag["median_m"]) == (4, pytest.approx(0.003))
    assert "view at 0 % of stops" in masks.note
