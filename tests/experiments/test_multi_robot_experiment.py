"""Teams of robots: where they are placed, and how they are judged."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ms_slam_experiments import multi_robot
from ms_slam_experiments.multi_robot import (
    MultiRobotSpec,
    PairMerge,
    Team,
    judge_team,
    overlap,
    place_robots,
    team_paths,
)

from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, so3_exp
from ms_slam_env.sequences import HandheldPath
from ms_slam_env.slam.team.map_merging import Fit, Merge
from ms_slam_env.slam.team.relative_map_poses import RobotRun


class _Map:
    """Stands for a SLAM of which only the map is asked."""

    def __init__(self, points: np.ndarray) -> None:
        self._points = points

    def surface_points(self) -> np.ndarray:
        return self._points


def exact_team(count: int) -> Team:
    """Robots that make no error; each sees a strip of a floor of its own."""
    truths, runs, strips = [], [], []
    for k in range(count):
        steps = np.tile(np.eye(4), (6, 1, 1))
        steps[:, 0, 3] = 0.1 * np.arange(6)
        truth = make_pose(so3_exp([0.1 * k, 0.3, k]), [k, 0.0, 1.0]) @ steps
        x, y = np.meshgrid(k + np.arange(0, 1, 0.02), np.arange(0, 1, 0.02))
        strip = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        T = invert(truth[0])
        points = strip @ T[:3, :3].T + T[:3, 3]
        runs.append(RobotRun(_Map(points), [None] * 6, T @ truth, np.ones(6, dtype=bool)))  # type: ignore[arg-type]
        truths.append(truth)
        strips.append(strip)
    floor = np.concatenate(strips)
    times = [np.arange(6) / 30 + 0.5 * k for k in range(count)]
    return Team(runs, truths, times, floor, floor, [1.0] * (count - 1))


def merged(T: np.ndarray | None) -> PairMerge:
    return PairMerge(Merge(T, "" if T is not None else "unseen", 5, 5, Fit(1.0, 1.0, 1.0)))


def test_a_team_is_placed_through_whoever_was_merged() -> None:
    team = exact_team(3)
    merges = {
        (0, 1): merged(None),
        (0, 2): merged(team.true_pose(0, 2)),
        (1, 2): merged(team.true_pose(1, 2)),
    }
    placed = place_robots(3, merges)
    assert list(placed) == [0, 1, 2]
    for k, T in placed.items():
        np.testing.assert_allclose(T, team.true_pose(0, k), atol=1e-9)
    found = judge_team(team, merges, MultiRobotSpec(robots=3))
    assert found["merged_robots"] == 3
    assert found["team_ate_unaligned_m"] == pytest.approx(0, abs=1e-9)
    assert found["team_rpe_m"] == pytest.approx(0, abs=1e-9)
    assert found["f_score_2cm"] == 1.0
    assert found["task_time_s"] == pytest.approx(1.0 + 5 / 30)
    assert found["mean_path_m"] == pytest.approx(0.5)
    assert [pair["merged"] for pair in found["pairs"]] == [False, True, True]
    assert not any(pair["wrong_merge"] for pair in found["pairs"])
    alone = found["alone"][0]
    assert alone["recall_2cm"] == pytest.approx(1 / 3, abs=0.02)
    assert list(place_robots(3, {**merges, (0, 2): merged(None)})) == [0]


def test_a_bad_merge_is_called_wrong() -> None:
    team = exact_team(2)
    spec = MultiRobotSpec()
    off = team.true_pose(0, 1) @ make_pose(np.eye(3), [0.2, 0, 0])
    found = judge_team(team, {(0, 1): merged(off)}, spec)
    (pair,) = found["pairs"]
    assert pair["wrong_merge"]
    assert pair["merge_error_m"] == pytest.approx(0.2)
    assert found["team_ate_unaligned_m"] == pytest.approx(0.2 / np.sqrt(2))
    foreign = dataclasses.replace(spec, setting="foreign")
    found = judge_team(team, {(0, 1): merged(team.true_pose(0, 1))}, foreign)
    assert found["pairs"][0]["wrong_merge"]  # another scene has no place in this one


def test_paths_of_a_team_share_what_they_see(box_scene, monkeypatch) -> None:
    path = HandheldPath(frames=12)
    paths, shared = team_paths(box_scene, path, 3, 2, 0.4)
    again, _ = team_paths(box_scene, path, 3, 2, 0.4)
    assert (len(paths), len(shared)) == (2, 1)
    assert shared[0] >= 0.4
    np.testing.assert_array_equal(paths, again)
    assert not np.allclose(paths[0], paths[1])
    assert overlap({(0,), (1,)}, {(1,), (2,), (3,)}) == 0.5
    monkeypatch.setattr(multi_robot, "_ATTEMPTS", 2)
    with pytest.raises(InputError, match=r"shares 100 %"):
        team_paths(box_scene, path, 3, 2, 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robots", "4"], "robots = 4 is outside [2, 3]"),
        (["--settings", "apart"], "unknown setting 'apart'"),
        (["--scenes", "mars"], "unknown scene 'mars'"),
        (["--image-size", "1x1"], "unknown image size"),
        (["--noise", "loud"], "unknown noise model"),
        (["--seeds", "mine"], "unknown split"),
        (["--merge.patience", "1"], "patience = 1"),
        (["--merge.sources", "gps"], "unknown source of guesses 'gps'"),
        (["--least-overlap", "2"], "least_overlap = 2"),
    ],
)
def test_bad_input(options, message, capsys) -> None:
    assert main(["experiment", "multi-robot", *options]) == 2
    assert message in capsys.readouterr().err
