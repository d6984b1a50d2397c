"""Merging maps of several robots, and the joint pose graph of a team."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from box_scene import BoxScene
from two_robots import TRUTHS, K, path_past, run_robot

from ms_slam_env import slam
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, se3_exp, so3_exp, transform_points
from ms_slam_env.metrics import inter_robot_rpe
from ms_slam_env.sequences import render_sequence
from ms_slam_env.slam.team.map_merging import (
    MergeConfig,
    consensus,
    decide,
    mean_pose,
    measure_fit,
    merge_maps,
    pose_difference,
)
from ms_slam_env.slam.team.relative_map_poses import (
    FEATURES,
    RELOCALISATION,
    Hypothesis,
    Landmarks,
    hypotheses_from_features,
    hypotheses_from_relocalisation,
    landmarks,
    match_landmarks,
    query_frames,
)
from ms_slam_env.slam.team.team_server import (
    ServerConfig,
    TeamEstimate,
    _carried_along,
    fuse_team,
    optimise_team,
)

CONFIG = MergeConfig(queries=5, lost_queries=2, patience=3)


@pytest.fixture(scope="module")
def robots(box_scene):
    return [run_robot(box_scene, truth, seed) for seed, truth in enumerate(TRUTHS)]


TRUE = invert(TRUTHS[0][0]) @ TRUTHS[1][0]
ORIGIN = np.zeros(3)


def test_a_known_transform_is_recovered(robots) -> None:
    before = robots[0].backend.get_state()
    merge = merge_maps(*robots, CONFIG)
    assert merge.reason == ""
    error_m, error_deg = pose_difference(merge.T_a_b, TRUE, ORIGIN)
    assert error_m < 0.01
    assert error_deg < 0.5
    assert merge.agreeing >= 3
    assert merge.fit.consistent > 0.95
    after = robots[0].backend.get_state()  # the search leaves no trace
    np.testing.assert_array_equal(before["poses"], after["poses"])
    np.testing.assert_array_equal(before["lost"], after["lost"])


def test_either_source_finds_it(robots) -> None:
    by_looks = hypotheses_from_features(*robots, 4)
    in_the_map = hypotheses_from_relocalisation(*robots, 2, 3)
    assert {guess.source for guess in by_looks} == {FEATURES}
    assert {guess.source for guess in in_the_map} == {RELOCALISATION}
    for guess in (*by_looks, *in_the_map):
        error_m, error_deg = pose_difference(guess.T_a_b, TRUE, ORIGIN)
        assert error_m < 0.05
        assert error_deg < 3.0


def test_maps_of_different_rooms_are_refused(robots) -> None:
    elsewhere = run_robot(BoxScene(seed=1), TRUTHS[1], seed=2)
    merge = merge_maps(robots[0], elsewhere, CONFIG)
    assert merge.T_a_b is None
    assert merge.reason
    # Even when all guesses agree on the pose at which the two rooms' walls coincide.
    deceived = decide(robots[0], elsewhere, [Hypothesis(TRUE, 10, FEATURES)] * 5, CONFIG)
    assert deceived.T_a_b is None
    assert deceived.reason == "the images do not look alike there"


def test_views_of_different_walls_are_refused(robots, box_scene) -> None:
    other_wall = np.array([2.0, -1.5, 1.2])
    truth = path_past(other_wall, np.array([0.0, 0.0, 1.3]), np.array([0.03, 0.0, 0.0]))
    other = run_robot(box_scene, truth, seed=3)
    assert merge_maps(robots[0], other, CONFIG).T_a_b is None
    true = invert(TRUTHS[0][0]) @ truth[0]
    apart = decide(robots[0], other, [Hypothesis(true, 10, FEATURES)] * 5, CONFIG)
    assert apart.reason == "the maps hardly overlap there"  # right, but nothing bears it out


def test_guesses_that_contradict_each_other_are_refused(robots) -> None:
    off = TRUE @ make_pose(np.eye(3), [0.5, 0, 0])
    guesses = [Hypothesis(T, 10, FEATURES) for T in (TRUE, off)] * 4
    assert decide(*robots, guesses, CONFIG).reason == "the frames contradict each other"
    few = decide(*robots, guesses[:2], CONFIG)
    assert few.reason == "too few frames show the other map"
    assert (few.found, few.agreeing) == (2, 1)


def test_registration_takes_back_a_small_error(robots) -> None:
    off = TRUE @ make_pose(so3_exp([0, 0.01, 0]), [0.03, 0.0, 0.02])
    merge = decide(*robots, [Hypothesis(off, 10, FEATURES)] * 5, CONFIG)
    assert merge.reason == ""
    assert pose_difference(merge.T_a_b, TRUE, ORIGIN)[0] < 0.01
    assert merge.refined_m > 0.02


def test_a_wrong_transform_contradicts_the_frames(robots) -> None:
    good = measure_fit(*robots, TRUE, CONFIG)
    away = measure_fit(*robots, TRUE @ make_pose(np.eye(3), [0, 0, -0.4]), CONFIG)
    assert good.consistent > 0.97
    assert good.overlap > 0.5
    assert good.alike > 0.8
    assert away.overlap < 0.5 * good.overlap


def test_robots_without_a_tracked_frame_are_not_merged(robots) -> None:
    blind = dataclasses.replace(robots[1], tracked=np.zeros(len(TRUTHS[1]), dtype=bool))
    assert merge_maps(robots[0], blind, CONFIG).reason == "a robot has tracked no frame"


def test_matching_points_give_their_motion_despite_wrong_matches() -> None:
    rng = np.random.default_rng(1)
    T = make_pose(so3_exp([0.3, -0.5, 1.0]), [0.4, -1.0, 2.0])
    points = rng.uniform(-1, 1, (40, 3))
    descriptors = rng.random((40, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    depth = np.ones(40)
    moved = transform_points(T, points) + rng.normal(0, 0.003, points.shape)
    moved[:15] = rng.uniform(-3, 3, (15, 3))  # look alike, but are others
    a, b = Landmarks(moved, descriptors, depth), Landmarks(points, descriptors, depth)
    other = Landmarks(rng.uniform(-1, 1, (40, 3)), descriptors, depth)
    found = match_landmarks([other, a], b, 8, 0.02, np.random.default_rng(0))
    assert found is not None
    distance, angle = pose_difference(found[0], T, ORIGIN)
    assert distance < 0.005
    assert angle < 0.3
    assert found[1] == 25
    assert match_landmarks([other], b, 8, 0.02, np.random.default_rng(0)) is None


def test_landmarks_lie_on_the_surface(box_scene) -> None:
    sequence = render_sequence(box_scene, TRUTHS[0][:1], K, "none")
    found = landmarks(sequence.frames[0], TRUTHS[0][0], K)
    assert len(found.points) > 50
    assert box_scene.clearance(found.points).max() < 0.02
    blank = dataclasses.replace(
        sequence.frames[0], color=np.full((*K.shape, 3), 99, dtype=np.uint8)
    )
    assert len(landmarks(blank, np.eye(4), K).points) == 0


def test_consensus_finds_the_cluster_and_its_mean() -> None:
    rng = np.random.default_rng(0)
    true = make_pose(so3_exp([0.2, -1.0, 0.4]), [1.0, 2.0, 0.5])
    near = [Hypothesis(true @ se3_exp(rng.normal(0, 0.005, 6)), 9, FEATURES) for _ in range(5)]
    far = [Hypothesis(make_pose(so3_exp([0, 0, k]), [k, 0, 0]), 9, FEATURES) for k in range(3)]
    found = consensus([far[0], *near, *far[1:]], ORIGIN, 0.1, 5.0)
    assert len(found) == 5
    assert all(any(one is other for other in near) for one in found)
    distance, angle = pose_difference(mean_pose(found, ORIGIN), true, ORIGIN)
    assert distance < 0.01
    assert angle < 0.5
    assert consensus([], ORIGIN, 0.1, 5.0) == []


def test_the_mean_follows_the_weights() -> None:
    a, b = (make_pose(np.eye(3), [x, 0.0, 0.0]) for x in (0.0, 0.04))
    guesses = [Hypothesis(a, 30, FEATURES), Hypothesis(b, 10, FEATURES)]
    np.testing.assert_allclose(mean_pose(guesses, np.ones(3))[:3, 3], [0.01, 0, 0], atol=1e-12)


def test_agreement_is_judged_where_the_robot_was() -> None:
    turned = make_pose(so3_exp([0, 0, np.radians(2)]), np.zeros(3))
    assert pose_difference(np.eye(4), turned, ORIGIN)[0] == 0.0
    distance, angle = pose_difference(np.eye(4), turned, np.array([10.0, 0, 0]))
    assert distance == pytest.approx(20 * np.sin(np.radians(1)))
    assert angle == pytest.approx(2.0)


def test_queries_are_spread_over_the_tracked_frames(robots) -> None:
    tracked = np.array([False, True, True, False, True, True, True, True, True, False])
    robot = dataclasses.replace(robots[0], tracked=tracked)
    assert query_frames(robot, 3) == [1, 5, 8]
    assert query_frames(robot, 99) == [1, 2, 4, 5, 6, 7, 8]


def test_frames_without_poses_are_refused(robots) -> None:
    with pytest.raises(InputError, match="10 frames but poses of shape"):
        dataclasses.replace(robots[1], estimates=robots[1].estimates[:3])
    none = {"frames": (), "estimates": np.zeros((0, 4, 4)), "tracked": np.zeros(0, dtype=bool)}
    with pytest.raises(InputError, match="without frames"):
        dataclasses.replace(robots[1], **none)


def test_a_team_merged_four_centimetres_off_is_brought_together(robots) -> None:
    pytest.importorskip("gtsam")
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
    pytest.importorskip("gtsam")
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
