"""The measurements of the environment's and the lookahead's speed, with a tiny budget."""

from dataclasses import asdict

import pytest

from ms_slam_env.experiments.env_speed import EnvSpeed, EnvSpeedSpec
from ms_slam_env.experiments.lookahead_speed import STAGES, LookaheadSpeed


def test_a_free_camera_is_measured_once_whatever_the_frames():
    specs = EnvSpeed(
        embodiments=("free", "fixed-translation"),
        observations=("features",),
        frames_per_action=(1, None, 5),
    ).specs()
    assert [(spec.embodiment, spec.frames_per_action) for spec in specs] == [
        ("free", 1),
        ("fixed-translation", 1),
    ]


def test_split_adds_up_to_the_step():
    spec = EnvSpeedSpec("free", 1, "lookahead", scene="carpet", seconds=0.05, warm_up=1)
    result = EnvSpeed.run(spec)
    stages = {one["stage"]: one["stage_ms"] for one in result["stages"]}
    assert result["measured_steps"] >= 1
    assert result["frames_per_step"] == 1
    assert result["steps_per_s"] == pytest.approx(1000 / result["step_ms"])
    assert sum(stages.values()) == pytest.approx(result["step_ms"])
    assert min(stages.values()) >= 0
    assert {"render", "slam", "lookahead", "rest"} <= set(stages)
    (table,) = EnvSpeed().tables([{"spec": asdict(spec), "result": result, "error": None}])
    names = [column.name for column in table.columns]
    assert names.index("render_ms") < names.index("slam_ms") < names.index("lookahead_ms")
    assert table.rows[0]["observation"] == "lookahead"
    assert names[-1] == "rest_ms"


def test_every_stage_of_the_lookahead_is_found_by_the_profiler():
    (spec,) = LookaheadSpeed("table", 1000, "80x60", surfels=1000, repeats=2).specs()
    result = LookaheadSpeed.run(spec)
    times = {one["stage"]: one["stage_ms"] for one in result["stages"]}
    assert set(STAGES) < set(times)
    missing = [stage for stage, ms in times.items() if ms == 0 and stage != "copy to the host"]
    assert missing == []
