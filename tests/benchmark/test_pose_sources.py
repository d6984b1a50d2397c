"""The comparison of pose sources, from rows of known content and from tiny episodes."""

import json

import pytest

from ms_slam_env.benchmark.pose_sources import COLUMNS, Arguments, as_table, compare, main
from ms_slam_env.errors import InputError

ERROR_M = {"slam": 0.010, "slam-kinematics": 0.008, "kinematics": 0.005, "ground_truth": 0.0}


def rows_of(args):
    """ATE by source, three times as large in the second seed; only ``slam`` gets lost there."""
    rows = []
    for spec in args.specs():
        source = spec.options["pose"]
        second = spec.seed == 2001
        ate = ERROR_M[source] * (3 if second else 1)
        result = {column.metric: ate for column in COLUMNS}
        result["lost"] = second and source == "slam"
        rows.append({"spec": vars(spec), "result": result, "error": None})
    return rows


def test_medians_shares_and_ratios():
    args = Arguments(planners=("random",), scenes=("table",), episodes=2)
    cells = compare(rows_of(args), ("table", "all"))["all"]["random"]
    assert list(cells) == list(ERROR_M)
    assert cells["slam"]["ate_m"]["value"] == pytest.approx(0.020)
    assert cells["slam"]["lost"]["value"] == 0.5
    assert cells["kinematics"]["lost"]["value"] == 0
    assert cells["kinematics"]["ate_ratio"]["value"] == pytest.approx(0.5)
    assert (
        cells["kinematics"]["ate_ratio"]["low"] <= 0.5 <= cells["kinematics"]["ate_ratio"]["high"]
    )
    assert cells["ground_truth"]["ate_ratio"]["value"] == 0


def test_only_episodes_that_every_source_finished_are_compared():
    args = Arguments(planners=("random", "greedy"), scenes=("table", "wall"), episodes=2)
    rows = rows_of(args)
    failed = next(
        row
        for row in rows
        if (row["spec"]["scene"], row["spec"]["seed"]) == ("wall", 2001)
        and row["spec"]["planner"] == "greedy"
    )
    failed |= {"result": None, "error": "RuntimeError: gone"}
    summary = compare(rows, ("table", "wall", "all"))
    assert {c["episodes"] for c in summary["wall"]["greedy"].values()} == {1}
    assert {c["episodes"] for c in summary["wall"]["random"].values()} == {2}
    assert {c["episodes"] for c in summary["all"]["greedy"].values()} == {3}
    assert len(as_table(summary).splitlines()) == 2 + 3 * 2 * 4


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"sources": ("odometry",)}, "valid choices: slam, slam-kinematics, kinematics"),
        ({"sources": ()}, "at least one"),
        ({"sources": ("slam", "slam")}, "must be different"),
        ({"options": ("pose=slam",)}, "option 'pose' is not free"),
        ({"seeds": "exam"}, "unknown split of seeds 'exam'"),
    ],
)
def test_bad_input(fields, reason):
    with pytest.raises(InputError, match=reason):
        Arguments(**fields).specs()


def test_command(tmp_path, capsys):
    out = tmp_path / "results"
    words = "--sources slam ground_truth --planners random --scenes carpet --episodes 1 --steps 2"
    words += " --env-id MSActiveSLAM-FreeCamera-v0"
    assert main([*words.split(), "--workers", "1", "--out", str(out)]) == 0
    table = capsys.readouterr().out
    assert (out / "table.md").read_text() in table
    content = json.loads((out / "pose_sources.json").read_text())
    cell = content["summary"]["carpet"]["random"]
    assert cell["ground_truth"]["ate_m"]["value"] == pytest.approx(0, abs=1e-9)
    assert cell["slam"]["ate_m"]["value"] > 0
    assert len(content["episodes"]) == 2
