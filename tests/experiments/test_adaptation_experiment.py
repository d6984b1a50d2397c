"""The experiment on run-time adaptation: its judgement, its comparison, its files."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
from ms_slam_experiments.adaptation import Adaptation, AdaptationSpec, comparison

from ms_slam_env.config import from_dict
from ms_slam_env.report.records import spec_key, to_plain
from ms_slam_env.report.tables import flattened


def row(seed: int, factor: float) -> dict:
    """A row of which everything is known."""
    run = {"cpu_ms_mean": 10.0, "ate_interpolated_m": 0.01}
    half = {"cpu_ms_mean": 5.0 * factor, "ate_interpolated_m": 0.02}
    runs = [{"configuration": "slow", **run}, {"configuration": "adaptive", **half}]
    return {"result": {"runs": runs}, "spec": {"seed": seed}, "error": None}


def test_the_comparison_is_paired():
    rows = [row(1, 0.9), row(2, 1.0), row(3, 1.1)]
    (cut,) = comparison(flattened(rows, "runs")).rows
    assert cut["configuration"] == "slow"
    assert cut["cpu_cut"].value == pytest.approx(0.5)
    assert cut["ate_cut"].value == pytest.approx(-1.0)
    assert cut["better_share"] == 0.0


def test_a_recorded_specification_can_be_run_again():
    spec = Adaptation(scenes=("table",), sequences=1).specs()[0]
    recorded = json.loads(json.dumps(to_plain(asdict(spec))))
    assert spec_key(from_dict(AdaptationSpec, recorded)) == spec_key(spec)
