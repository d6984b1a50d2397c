"""The measurement of the SLAM's speed, with a tiny budget."""

import json

import numpy as np
import pytest

from ms_slam_env.benchmark.slam_speed import (
    SlamSpeedConfig,
    backend_parameters,
    main,
    run_child,
)
from ms_slam_env.benchmark.slam_speed_child import APART_M, with_far_places
from ms_slam_env.benchmark.slam_speed_report import summarise
from ms_slam_env.errors import InputError

WORDS = "--scene carpet --seed 1000 --sizes 80x60 --frames 5 --warm-up 2 --repeats 1"


def test_stages_add_up_and_stored_surfels_are_as_asked(tmp_path, capsys):
    words = [*WORDS.split(), "--stored", "30000", "--backend", "compaction_interval=7"]
    assert main([*words, "--against", ".", "--out", str(tmp_path)]) == 0
    data = json.loads((tmp_path / "slam_speed.json").read_text())
    assert [row["version"] for row in data["summary"]] == ["other", "this"]
    for row in data["summary"]:
        assert 30_000 <= row["surfels"] < 35_000
        assert sum(row["stages_ms"].values()) == pytest.approx(row["mean_ms"])
        assert min(row["stages_ms"].values()) >= 0
        assert row["lost_frames"] == 0
    assert data["summary"][1]["same_estimates"] is True
    assert data["summary"][1]["ratio"] > 0
    assert (tmp_path / "slam_speed.png").stat().st_size > 1000
    header, _, *lines = capsys.readouterr().out.strip().splitlines()
    assert {line.count("|") for line in lines} == {header.count("|")}


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
    rows = [
        {
            "version": version,
            "size": "8x8",
            "target": 1,
            "surfels": 5.0,
            "frame_ms": [time],
            "stages_ms": {"fuse": [time / 2]},
            "lost_frames": 0,
            "estimates": version,
        }
        for version, times in (("this", (1.0, 2.0, 9.0)), ("other", (2.0, 2.0, 3.0)))
        for time in times
    ]
    new = next(row for row in summarise(rows) if row["version"] == "this")
    assert new["ratio"] == 1.0
    assert new["mean_ms"] == 2.0
    assert new["same_estimates"] is False


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"frames": 1}, "SlamSpeedConfig.frames = 1 is outside"),
        ({"warm_up": 80}, "SlamSpeedConfig.warm_up = 80 is outside"),
        ({"stored": (0,)}, "must hold integers"),
    ],
)
def test_bad_input(fields, reason):
    with pytest.raises(InputError, match=reason):
        SlamSpeedConfig(**fields)


def test_bad_checkout_and_parameter(tmp_path):
    with pytest.raises(InputError, match="holds no package"):
        SlamSpeedConfig(against=tmp_path)
    with pytest.raises(InputError, match="name=value"):
        backend_parameters(("coverage_px",))
    assert backend_parameters(("iterations=[1, 2]",)) == {"iterations": [1, 2]}
