"""Difficulty against error, divergence against light, and the orbit: by closed forms and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from ms_slam_experiments.difficulty_errors import DifficultyErrors, correlations
from ms_slam_experiments.light_tolerance import LightSpec, LightTolerance, relit
from ms_slam_experiments.orbit import Orbit
from ms_slam_experiments.shared.loop_paths import around_object
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from ms_slam_env import scenes
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.cli import main


def rows(count: int = 8) -> list[dict]:
    rng = np.random.default_rng(0)
    made = []
    for k in range(count):
        hard = rng.normal(size=2)
        errors = {"ate_m": abs(rng.normal()), "rpe_m": float(np.exp(hard[0])), "lost_share": 0.0}
        measures = [
            {"measure": name, "divergence": "depth", "difficulty": float(value)}
            for name, value in zip(("kl", "earth-movers"), hard, strict=True)
        ]
        result = {"measures": measures, "backends": [{"backend": "surfel", **errors}]}
        made.append({"spec": {"sequence": f"s{k}"}, "result": result, "error": None})
    return made


def test_correlations_are_scipys_over_the_sequences() -> None:
    given = rows()
    found = {line["measure"]: line for line in correlations(given)}
    ate = [row["result"]["backends"][0]["ate_m"] for row in given]
    for m, name in enumerate(("kl", "earth-movers")):
        hard = [row["result"]["measures"][m]["difficulty"] for row in given]
        correlation = found[name]["correlation_ate"]
        assert correlation.value == pytest.approx(spearmanr(hard, ate).statistic)
        assert -1 <= correlation.low < correlation.value < correlation.high <= 1
    assert found["kl"]["correlation_rpe"].value == pytest.approx(1)
    assert np.isnan(found["kl"]["correlation_lost"].value)  # nobody was lost: nothing to go with
    tables = DifficultyErrors().tables([*given, {"spec": {}, "result": None, "error": "broke"}])
    assert "Over 8 sequences" in tables[0].note
    assert correlations([]) == []


def test_light_is_linear_and_no_change_is_no_divergence() -> None:
    color = np.tile(np.arange(0, 240, 16, dtype=np.uint8)[None, :, None], (4, 1, 3))
    frame = RGBDFrame(color, np.ones((4, 15), np.float32))
    np.testing.assert_array_equal(relit(frame, 1.0, 0.0).color, color)
    np.testing.assert_array_equal(relit(frame, 1.0, 5.0).color, color + 5)
    twice = relit(frame, 2.0, 0.0).color.astype(float)
    expected = np.minimum(color * 2 ** (1 / 2.2), 255)
    np.testing.assert_allclose(twice, expected, atol=0.5)
    found = LightTolerance.run(LightSpec("table:1000", (1.0, 1.3), (), 3, 1))["lights"]
    ratios = {(one["light"], one["measure"]): one["light_to_motion"] for one in found}
    assert all(v == 0 for (light, _), v in ratios.items() if light == "exposure x 1")
    assert all(v > 1 for (light, _), v in ratios.items() if light == "exposure x 1.3")


def test_an_orbit_goes_round_what_it_looks_at() -> None:
    scene = scenes.make("table", 1000)
    poses, lap = around_object(scene, 3, laps=2)
    assert len(poses) // 2 == lap
    apart = cKDTree(poses[lap:, :3, 3]).query(poses[:lap, :3, 3])[0]
    assert 0.05 < np.sqrt((apart**2).mean()) < 0.12
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() <= 0.0401  # also from lap to lap
    places = poses[:lap, :3, 3]
    centre = (places.max(axis=0) + places.min(axis=0)) / 2
    radius = np.linalg.norm((places - centre)[:, :2], axis=1)
    assert np.ptp(radius) < 0.2
    assert scene.clearance(poses[:, :3, 3]).min() > 0.1
    gaze = poses[:lap, :3, 2]
    inward = (centre - places)[:, :2] / radius[:, None]
    assert ((gaze[:, :2] * inward).sum(axis=1) > 0.3).all()
    assert (gaze[:, 2] < 0).all()  # the table stands below the camera


@pytest.mark.parametrize("seed", [2000, 2001])
@pytest.mark.parametrize("name", ["table", "living_room"])
def test_no_two_laps_of_an_orbit_are_alike(name: str, seed: int) -> None:
    scene = scenes.make(name, seed)
    poses, lap = around_object(scene, seed, laps=3)
    assert scene.clearance(poses[:, :3, 3]).min() > 0.05
    for a, b in ((0, 1), (0, 2), (1, 2)):
        own, other = (poses[k * lap : (k + 1) * lap, :3, 3] for k in (a, b))
        apart = cKDTree(other).query(own)[0]
        assert 0.04 < np.sqrt((apart**2).mean()) < 0.14


def test_every_length_of_the_dark_is_run_with_every_backend() -> None:
    specs = Orbit(scenes=("table",), recordings=1).specs()
    assert len(specs) == 2 * 3
    assert {spec.black_frames for spec in specs} == {10, 40}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["orbit", "--black-frames", "0"], "numbers of frames, >= 1"),
        (["orbit", "--backends", "lidar"], "unknown SLAM backend 'lidar'"),
        (["light-tolerance", "--gains", "-1"], "must be > 0"),
        (["difficulty-errors", "--sequences", "table:1"], "at least 3 sequences"),
        (["difficulty-errors", "--backends", "lidar"], "unknown SLAM backend 'lidar'"),
    ],
)
def test_bad_input(command, message, capsys) -> None:
    assert main(["experiment", *command]) == 2
    assert message in capsys.readouterr().err
