"""Speed of SLAM, of batches, of the environment and of the lookahead, with tiny budgets."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from ms_slam_experiments.env_speed import EnvSpeed
from ms_slam_experiments.lookahead_speed import STAGES, LookaheadSpeed
from ms_slam_experiments.shared.slam_speed_child import APART_M, with_far_places
from ms_slam_experiments.slam_speed import SlamSpeed, backend_parameters, run_child, summarise

from ms_slam_env.errors import InputError

TINY = {"scene": "carpet", "seed": 1000, "sizes": ("80x60",), "frames": 5, "warm_up": 2}


def test_stages_add_up_and_stored_surfels_are_as_asked():
    options = {
        "stored": (30_000,),
        "repeats": 1,
        "backend": ("compaction_interval=7", "acceptance.cost=1.3"),
    }
    experiment = SlamSpeed(**TINY, **options, against=Path())
    specs = experiment.specs()
    assert [spec.version for spec in specs] == ["this", "other"]
    rows = [{"spec": asdict(s), "result": SlamSpeed.run(s), "error": None} for s in specs]
    for row in rows:
        (run,) = row["result"]["runs"]
        stages = [one["stage_cpu_ms"] for one in run["stages"]]
        assert 30_000 <= run["surfels_stored"] < 35_000
        assert sum(stages) == pytest.approx(run["cpu_ms_mean"])
        assert min(stages) >= 0
        assert run["lost_frames"] == 0
    other, this = experiment.tables(rows)[0].rows
    assert this["same_poses"] is True
    assert this["cpu_ratio"] > 0
    assert other["cpu_ratio"] is None
    assert len(experiment.charts(rows)[0].panels[0].series) == 2


def test_the_package_of_the_other_checkout_is_used(tmp_path):
    package = tmp_path / "ms_slam_env"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('another package')")
    with pytest.raises(RuntimeError, match="another package"):
        run_child({}, tmp_path)


def test_far_places_are_older_stable_and_out_of_sight():
    rng = np.random.default_rng(0)
    here = {
        "position": rng.uniform(-5, 5, (100, 3)).astype(np.float32),
        "normal": np.tile(np.float32([1, 0, 0]), (100, 1)),
        "radius": np.ones(100, dtype=np.float32),
        "confidence": np.linspace(0, 20, 100, dtype=np.float32),
    }
    counters = {"count": np.int32([100]), "dead": np.int32([1])}
    state = {"map": {"surfels": [here], "counters": counters}}
    grown = with_far_places(state, 730, 10.0)["map"]
    surfels = grown["surfels"][0]
    assert grown["counters"]["count"][0] == 730
    assert counters["count"][0] == 100
    np.testing.assert_array_equal(surfels["position"][-100:], here["position"])
    assert (surfels["confidence"][:-100] >= 10).all()
    distance = np.linalg.norm(surfels["position"][:-100], axis=1)
    assert distance.min() > APART_M - 10
    places = {tuple(np.round(p / APART_M).astype(int)) for p in surfels["position"][:-100]}
    assert len(places) == 7
    np.testing.assert_allclose(np.linalg.norm(surfels["normal"], axis=1), 1, rtol=1e-5)


def test_the_ratio_is_the_median_over_rounds():
    stages = ("preprocess", "render", "track", "fuse", "rest")
    rows = [
        {
            "spec": {"version": version, "size": "80x60"},
            "result": {
                "runs": [
                    {
                        "target_surfels": 1,
                        "surfels_stored": 5.0,
                        "cpu_ms_mean": time,
                        "cpu_ms_median": time,
                        "stages": [{"stage": name, "stage_cpu_ms": time / 5} for name in stages],
                        "lost_frames": 0,
                        "poses_sha256": version,
                    }
                ]
            },
            "error": None,
        }
        for version, times in (("this", (1.0, 2.0, 9.0)), ("other", (2.0, 2.0, 3.0)))
        for time in times
    ]
    this = next(line for line in summarise(rows) if line["version"] == "this")
    assert this["cpu_ratio"] == 1.0
    assert this["cpu_ms_mean"] == 2.0
    assert this["same_poses"] is False


def test_bad_checkout_and_parameter(tmp_path):
    with pytest.raises(InputError, match="holds no package"):
        SlamSpeed(against=tmp_path)
    with pytest.raises(InputError, match="'coverage_px' is not option=value"):
        backend_parameters(("coverage_px",))
    with pytest.raises(
        InputError, match=r"unknown option.*motion_musk'; valid choices: .*motion_mask"
    ):
        backend_parameters(("motion_musk=none",))
    words = ("iterations=[1, 2]", "motion_mask=none", "acceptance.inliers=0.4")
    parameters = {"iterations": [1, 2], "motion_mask": "none", "acceptance.inliers": 0.4}
    assert backend_parameters(words) == parameters


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


def test_every_stage_of_the_lookahead_is_found_by_the_profiler():
    (spec,) = LookaheadSpeed("table", 1000, "80x60", surfels=1000, repeats=2).specs()
    result = LookaheadSpeed.run(spec)
    times = {one["stage"]: one["stage_ms"] for one in result["stages"]}
    assert set(STAGES) < set(times)
    missing = [stage for stage, ms in times.items() if ms == 0 and stage != "copy to the host"]
    assert missing == []
