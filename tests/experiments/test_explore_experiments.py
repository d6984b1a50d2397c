"""Studies around explorations: samplers on one function, and divergence by the rate of frames."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ms_slam_experiments.explore_rates import ExploreRates, front_of_trials
from ms_slam_experiments.explore_samplers import ExploreSamplers, summarise

from ms_slam_env.benchmark import Experiment
from ms_slam_env.benchmark.rows import write_all
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import look_at
from ms_slam_env.report.records import Row
from ms_slam_env.report.results import Results
from ms_slam_env.sequences import render_sequence
from ms_slam_env.sequences.writing import write_sequence


@pytest.fixture(scope="module")
def sequence(box_scene, tmp_path_factory) -> str:
    """A short sequence of the box scene, 80x60."""
    eye = box_scene.sample_start(np.random.default_rng(0))[:3, 3]
    low, high = box_scene.mesh.vertices.min(0), box_scene.mesh.vertices.max(0)
    poses = [look_at(eye + np.array([0.01 * k, 0, 0]), (low + high) / 2) for k in range(12)]
    folder = tmp_path_factory.mktemp("sequences") / "right"
    write_sequence(render_sequence(box_scene, np.stack(poses), xtion("80x60")), folder, {})
    return str(folder)


def results_of(experiment: Experiment, out: Path) -> tuple[list[Row], Results]:
    rows: list[Row] = [
        {"spec": asdict(spec), "result": type(experiment).run(spec), "error": None}
        for spec in experiment.specs()
    ]
    return rows, write_all(experiment, rows, out)


def test_samplers_are_compared_seed_by_seed():
    values = {"random": [(0.1, 0.2), (0.2, 0.4)], "tpe": [(0.1, 0.3), (0.3, 0.5)]}
    rows: list[Row] = [
        {
            "spec": {"sampler": name, "seed": seed},
            "result": {"hypervolume_half": half, "hypervolume": end},
            "error": None,
        }
        for name, found in values.items()
        for seed, (half, end) in enumerate(found)
    ]
    random, tpe = summarise(rows)
    assert "gain" not in random
    assert tpe["hypervolume_half"].value == pytest.approx(0.2)
    assert tpe["hypervolume"].value == pytest.approx(0.4)
    assert (tpe["gain"].value, tpe["gain"].low) == (pytest.approx(0.1), pytest.approx(0.1))
    assert (tpe["wins"], tpe["seeds"]) == (2, 2)


def test_samplers_explore_one_function(sequence, tmp_path):
    experiment = ExploreSamplers(
        ("random", "nsga2", "tpe"),
        2,
        4,
        (sequence,),
        ("keep_every=1:3",),
        image_size="80x60",
        evaluations=tmp_path / "evaluations.jsonl",
    )
    rows, results = results_of(experiment, tmp_path)
    assert rows[-1]["result"]["measured_points"] == rows[-1]["result"]["grid_points"] == 3
    assert len((tmp_path / "evaluations.jsonl").read_text().splitlines()) == 3
    for row in rows:
        history = row["result"]["hypervolume_over_trials"]
        assert len(history) == 4
        assert np.all(np.diff(history) >= 0)
        assert history[0] == pytest.approx(0.25)  # the default: half the reference
    assert [line["sampler"] for line in results.tables[0].rows] == ["random", "nsga2", "tpe"]
    assert (tmp_path / "hypervolume.png").stat().st_size > 0


def test_rates_have_a_front_each(sequence, tmp_path):
    experiment = ExploreRates((1, 3), ("random", "tpe"), 1, 3, (sequence,), image_size="80x60")
    rows, results = results_of(experiment, tmp_path)
    lines: Any = results.tables[0].rows
    assert [(line["keep_every"], line["sampler"]) for line in lines] == [
        (1, "random"), (1, "tpe"), (3, "random"), (3, "tpe"),
    ]  # fmt: skip
    assert lines[2]["M_I"] > lines[0]["M_I"]  # fewer frames, more divergence
    assert lines[0]["M_I"] == lines[1]["M_I"]
    default = rows[0]["result"]["trials"][0]["parameters"]
    assert default == "depth_cutoff_m=3.0, icp_rgb_weight=0.1, confidence_threshold=10.0"
    for line in lines:
        assert line["count"] == 3
        assert line["error"] <= line["default_error"]
        assert line["cost"] <= line["default_cost"]
    assert (tmp_path / "fronts.png").stat().st_size > 0
    for row in rows:  # the default broke down: the others stand
        row["result"]["trials"][0] = {"parameters": default, "failed": True}
    (table,) = experiment.tables(rows)
    assert [(line["default_error"], line["cost"]) for line in table.rows] == [(None, None)] * 4
    assert len(experiment.charts(rows)[0].panels) == 2


def test_a_front_of_trials_is_what_none_beats():
    values = [(3.0, 0.1), (1.0, 0.3), (2.0, 0.3), (2.0, 0.2), (4.0, 0.1)]
    trials = [{"cpu_ms_median": cost, "ate_max_m": error} for cost, error in values]
    found = [(t["cpu_ms_median"], t["ate_max_m"]) for t in front_of_trials(trials)]
    assert found == [(1.0, 0.3), (2.0, 0.2), (3.0, 0.1)]
