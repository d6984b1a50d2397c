"""The comparison of pose sources, from rows of known content."""

import pytest
from ms_slam_experiments.pose_sources import METRICS, PoseSourceExperiment

ERROR_M = {"slam": 0.010, "slam-kinematics": 0.008, "kinematics": 0.005, "ground_truth": 0.0}


def rows_of(experiment):
    """ATE by source, three times as large in the second seed; only ``slam`` gets lost there."""
    rows = []
    for spec in experiment.specs():
        source = spec.options["pose"]
        second = spec.seed == 2001
        ate = ERROR_M[source] * (3 if second else 1)
        result = {**dict.fromkeys(METRICS, ate), "lost": second and source == "slam"}
        rows.append({"spec": vars(spec), "result": result, "error": None})
    return rows


def cell(experiment, rows, **fields):
    """The line of the table that has these values."""
    (found,) = [
        line
        for line in experiment.tables(rows)[0].rows
        if all(line[name] == value for name, value in fields.items())
    ]
    return found


def test_medians_shares_and_ratios():
    experiment = PoseSourceExperiment(planners=("random",), scenes=("table",), episodes=2)
    rows = rows_of(experiment)
    lines = experiment.tables(rows)[0].rows
    assert [line["pose_source"] for line in lines] == [*ERROR_M, *ERROR_M]
    slam, kinematics, truth = (
        cell(experiment, rows, scene="all", pose_source=source)
        for source in ("slam", "kinematics", "ground_truth")
    )
    assert slam["ate_m"].value == pytest.approx(0.020)
    assert slam["lost"].value == 0.5
    assert kinematics["lost"].value == 0
    assert kinematics["ate_ratio"].value == pytest.approx(0.5)
    assert kinematics["ate_ratio"].low <= 0.5 <= kinematics["ate_ratio"].high
    assert truth["ate_ratio"].value == 0


def test_only_episodes_that_every_source_finished_are_compared():
    experiment = PoseSourceExperiment(
        planners=("random", "greedy"), scenes=("table", "wall"), episodes=2
    )
    rows = rows_of(experiment)
    failed = next(
        row
        for row in rows
        if (row["spec"]["scene"], row["spec"]["seed"]) == ("wall", 2001)
        and row["spec"]["planner"] == "greedy"
    )
    failed |= {"result": None, "error": "RuntimeError: gone"}
    counts = {
        (line["scene"], line["planner"]): line["episodes"]
        for line in experiment.tables(rows)[0].rows
    }
    assert counts["wall", "greedy"] == 1
    assert counts["wall", "random"] == 2
    assert counts["all", "greedy"] == 3
