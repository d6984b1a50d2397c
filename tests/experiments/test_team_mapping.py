"""Teams that map to a coverage goal: who divides what, when the task ends, what is refused."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ms_slam_baselines.team_nbv import TeamNextBestView, looked_at
from ms_slam_experiments.team_mapping import TeamMapping, TeamMappingSpec, nearby_starts

from ms_slam_env.camera import xtion
from ms_slam_env.cli import main
from ms_slam_env.env.coverage import CoverageGrid, team_share
from ms_slam_env.geometry import look_at, make_pose
from ms_slam_env.sensor import RGBDSensor


def test_the_reach_is_that_of_the_shared_map() -> None:
    config = SimpleNamespace(step_m=0.1, step_rad=0.2, frames_per_action=1)
    env: Any = SimpleNamespace(config=config)
    assert TeamNextBestView(env, reach_m=5.0).map.grid.reach_m == 5.0


def planner(spread_m: float) -> TeamNextBestView:
    config = SimpleNamespace(step_m=0.12, step_rad=0.2, frames_per_action=1)
    made = TeamNextBestView(SimpleNamespace(config=config), spread_m=spread_m)  # type: ignore[arg-type]
    made.reset()
    return made


def test_what_a_team_mate_is_to_look_at_is_left_to_it() -> None:
    one, other = planner(3.0), planner(3.0)
    for mate in (one, other):
        mate.join([one, other])
    assert one.map is other.map
    goals = np.stack([make_pose(np.eye(3), [x, 0, 0]) for x in (0.0, 1.5, 6.0)])
    np.testing.assert_array_equal(one.left_over(goals), 1)  # the other has no goal yet
    other.goal = goals[0]
    np.testing.assert_allclose(one.left_over(goals), [0, 0.5, 1])
    np.testing.assert_array_equal(planner(0.0).left_over(goals), 1)
    np.testing.assert_allclose(looked_at(goals)[1], [1.5, 0, 1.5])


def test_a_team_has_mapped_what_one_of_it_has(box_scene) -> None:
    K = xtion("80x60")
    sensor = RGBDSensor(box_scene, K, noise="none")
    grids = [CoverageGrid(box_scene, K.rays()) for _ in range(3)]
    poses = [look_at([0, 0, 1.2], [x, 1.5, 1.0]) for x in (-1.5, 1.5)]
    for own, looks in zip(grids, ([0], [1], [0, 1]), strict=True):
        for k in looks:
            depth = sensor.ground_truth(poses[k]).depth
            own.see(depth, depth, poses[k], poses[k])
    assert team_share(grids[:1]) == grids[0].mapped_share > 0
    assert team_share(grids[:2]) == grids[2].mapped_share > 1.5 * grids[0].mapped_share


def test_robots_start_near_the_first_and_apart(box_scene) -> None:
    first = box_scene.sample_start(np.random.default_rng(0))
    starts = nearby_starts(box_scene, first, 3, 1)
    np.testing.assert_array_equal(starts[0], first)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.linalg.norm(starts[a][:3, 3] - starts[b][:3, 3]) >= 0.5
    assert len(nearby_starts(box_scene, first, 1, 1)) == 1


@pytest.fixture(scope="module")
def results():
    spec = TeamMappingSpec("living_room", 1000, 2, 0.02, 4)
    never = dataclasses.replace(spec, robots=1, goal=1.0, steps=2)
    return {s: TeamMapping.run(s) for s in (spec, never)}


def test_the_task_ends_at_the_goal_or_never(results) -> None:
    reached, never = results.values()
    assert reached["covered_share"] >= 0.02
    assert reached["steps_to_goal"] == len(reached["covered_share_over_steps"]) - 1
    assert reached["task_time_s"] == pytest.approx(reached["steps_to_goal"] / 30)
    assert never["steps_to_goal"] == never["task_time_s"] == math.inf
    assert never["between_robots_m"] is None
    assert len(never["covered_share_over_steps"]) == 3
    rows = [
        {"spec": dataclasses.asdict(spec), "result": result, "error": None}
        for spec, result in results.items()
    ]
    summary, teams = TeamMapping().tables(rows)
    assert "never" in teams.as_markdown()
    assert len(summary.rows) == 2
    assert TeamMapping().charts(rows)[0].panels


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scenes", "mars", "--goals", "0.5"], "unknown scene 'mars'"),
        (["--goals", "0.5"], "one for each scene"),
        (["--goals", "0.5", "2"], "must be shares"),
        (["--robots", "0"], "must be sizes of teams"),
        (["--planner", "nobody"], "unknown planner 'nobody'"),
    ],
)
def test_bad_input(options, message, capsys) -> None:
    assert main(["experiment", "team-mapping", *options]) == 2
    assert message in capsys.readouterr().err
