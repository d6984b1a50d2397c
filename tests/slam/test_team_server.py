"""The server of a team: does the joint pose graph bring robots to where they are?"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from two_robots import TRUTHS, K, run_robot

from ms_slam_env import slam
from ms_slam_env.geometry import make_pose, se3_exp, so3_exp
from ms_slam_env.metrics import inter_robot_rpe
from ms_slam_env.slam.team.team_server import (
    ServerConfig,
    TeamEstimate,
    _carried_along,
    fuse_team,
    optimise_team,
)

pytest.importorskip("gtsam")


@pytest.fixture(scope="module")
def robots(box_scene):
    return [run_robot(box_scene, truth, seed) for seed, truth in enumerate(TRUTHS)]


def test_a_team_merged_four_centimetres_off_is_brought_together(robots) -> None:
    off = make_pose(so3_exp([0.0, 0.0, 0.02]), [0.03, -0.02, 0.02])
    placed = {0: TRUTHS[0][0], 1: TRUTHS[1][0] @ off}
    before = [T @ robots[k].estimates for k, T in placed.items()]
    made = optimise_team(robots, placed, ServerConfig(keyframes=5, cutoff_m=0.1))
    after = list(made.trajectories.values())
    assert made.links >= 4
    assert inter_robot_rpe(before, TRUTHS).rmse > 0.04
    assert inter_robot_rpe(after, TRUTHS).rmse < 0.25 * inter_robot_rpe(before, TRUTHS).rmse
    np.testing.assert_allclose(after[0][0], TRUTHS[0][0], atol=1e-4)  # the tie to the world


def test_robots_that_saw_nothing_in_common_stay_where_they_are(robots) -> None:
    far = make_pose(np.eye(3), [50.0, 0.0, 0.0])
    placed = {0: TRUTHS[0][0], 1: far @ TRUTHS[1][0]}
    made = optimise_team(robots, placed, ServerConfig(keyframes=4))
    assert made.links == 0
    for k, T in placed.items():
        np.testing.assert_allclose(made.trajectories[k], T @ robots[k].estimates, atol=1e-9)


def test_frames_between_keyframes_move_with_both() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    ends = np.stack([np.eye(4), se3_exp([0.4, 0, 0, 0, 0, 0])])
    moved = _carried_along(poses, np.array([0, 4]), ends)
    np.testing.assert_allclose(moved[:, 0, 3], [0, 0.1, 0.2, 0.3, 0.4], atol=1e-12)
    np.testing.assert_allclose(_carried_along(poses, np.array([2]), ends[1:])[:, 0, 3], 0.4)


def test_the_fused_map_holds_what_both_robots_saw(robots, box_scene) -> None:
    truth = TeamEstimate(dict(enumerate(TRUTHS)), 0)
    fused = fuse_team(slam.make("surfel", K), robots, truth).map_points()
    assert np.median(np.abs(box_scene.clearance(fused))) < 0.01
    alone = [
        (lambda T, p: p @ T[:3, :3].T + T[:3, 3])(TRUTHS[k][0], robots[k].backend.map_points())
        for k in (0, 1)
    ]
    for cloud in alone:
        low, high = fused.min(axis=0), fused.max(axis=0)
        assert (cloud > low - 0.1).all()
        assert (cloud < high + 0.1).all()


def test_an_untracked_frame_is_not_fused(robots) -> None:
    blind = [dataclasses.replace(r, tracked=np.zeros(len(r.frames), bool)) for r in robots[:1]]
    made = TeamEstimate({0: TRUTHS[0]}, 0)
    assert len(fuse_team(slam.make("surfel", K), blind, made).map_points()) == 0
