"""The experiment on run-time adaptation: its judgement, its comparison, its files."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
from ms_slam_experiments.adaptation import Adaptation, AdaptationSpec, comparison, judge

from ms_slam_env import slam
from ms_slam_env.cli import main
from ms_slam_env.config import from_dict
from ms_slam_env.report.records import spec_key, to_plain
from ms_slam_env.report.tables import flattened
from ms_slam_env.sequences import MotionSegments, open_sequence
from ms_slam_env.slam.adaptation import make_config

SHORT = MotionSegments(frames=24, quiet=12, violent=10, factor=8.0, rate_hz=30.0)


def test_judging_an_adaptive_run():
    sequence = open_sequence("table:1000", "160x120", path=SHORT)
    frames = list(sequence.frames)
    backend = make_config(
        "divergence",
        configurations=[{"keep_every": 3}, {}],
        thresholds=[1.0],
        dwell_frames=1,
        start=0,
    ).adapt(slam.make("surfel", sequence.intrinsics))
    figures, levels, changes = judge(backend, frames, sequence.poses, SHORT.is_violent())
    assert levels == [0] * 24
    assert figures["processed_share"] == pytest.approx(8 / 24)
    assert changes[0] == 0
    assert min(changes[1:]) > 0
    assert figures["lost_share"] == 0
    assert 0 < figures["ate_interpolated_m"] <= figures["ate_interpolated_max_m"]
    assert figures["cpu_ms_mean"] > 0


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


@pytest.mark.slow
def test_one_command_writes_table_figures_and_configurations(tmp_path, capsys):
    words = "--scenes table --sequences 1 --image-size 80x60 --stretches.frames 12"
    words += f" --stretches.quiet 5 --stretches.violent 5 --out {tmp_path}"
    assert main(["experiment", "adaptation", *words.split()]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"table.md", "results.json", "error_time.png", "time_line.png"} <= names
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["rows"][0]["result"]["runs"][-1]["configuration"] == "adaptive"
    assert len(content["rows"][0]["result"]["level"]) == 12
    assert content["configurations"][0]["keep_every"] > 1
    assert "What adaptation cuts" in capsys.readouterr().out


def test_a_recorded_specification_can_be_run_again():
    spec = Adaptation(scenes=("table",), sequences=1).specs()[0]
    recorded = json.loads(json.dumps(to_plain(asdict(spec))))
    assert spec_key(from_dict(AdaptationSpec, recorded)) == spec_key(spec)
