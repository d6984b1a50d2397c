"""Several robots: a known transform is recovered, maps that share nothing are not merged."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from box_scene import BoxScene

from ms_slam_env import slam
from ms_slam_env.benchmark import (
    multi_robot,
    multi_robot_paths,
    multi_robot_report,
    multi_robot_run,
)
from ms_slam_env.benchmark.map_hypotheses import (
    FEATURES,
    RELOCALISATION,
    Hypothesis,
    RobotRun,
    consensus,
    mean_pose,
    pose_difference,
    query_frames,
    recognised,
    relocalised,
)
from ms_slam_env.benchmark.map_matching import Landmarks, landmarks, match_landmarks
from ms_slam_env.benchmark.map_merging import Fit, Merge, MergeConfig, decide, judge, merge_maps
from ms_slam_env.benchmark.multi_robot_paths import overlap, team_paths
from ms_slam_env.benchmark.multi_robot_run import PairMerge, Team, judge_team, place_robots
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, look_at, make_pose, se3_exp, so3_exp, transform_points
from ms_slam_env.sequences import HandheldPath, render_sequence

K = xtion("160x120")
CONFIG = MergeConfig(queries=5, lost_queries=2, patience=3)


def path_past(
    target: np.ndarray, eye: np.ndarray, step: np.ndarray, frames: int = 10
) -> np.ndarray:
    return np.stack([look_at(eye + k * step, target) for k in range(frames)])


def run_robot(scene, truth: np.ndarray, seed: int) -> RobotRun:
    """A robot whose SLAM is told its poses, in the frame of its first camera."""
    backend = slam.make("surfel", K)
    backend.reset()
    frames = tuple(render_sequence(scene, truth, K, "kinect", seed).frames)
    estimates = invert(truth[0]) @ truth
    for frame, pose in zip(frames, estimates, strict=True):
        backend.fuse(frame, pose)
    return RobotRun(backend, frames, estimates, np.ones(len(frames), dtype=bool))


CORNER = np.array([-2.0, 1.5, 1.0])
TRUTHS = (
    path_past(CORNER, np.array([0.0, 0.2, 1.3]), np.array([0.0, 0.03, 0.0])),
    path_past(CORNER, np.array([0.1, 0.6, 1.4]), np.array([-0.03, 0.0, 0.01])),
)


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
    by_looks = recognised(*robots, 4)
    in_the_map = relocalised(*robots, 2, 3)
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
    good = judge(*robots, TRUE, CONFIG)
    away = judge(*robots, TRUE @ make_pose(np.eye(3), [0, 0, -0.4]), CONFIG)
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
    found = judge_team(team, merges, multi_robot_run.MultiRobotSpec(robots=3))
    assert found["merged_robots"] == 3
    assert found["team_ate_unaligned_m"] == pytest.approx(0, abs=1e-9)
    assert found["team_rpe_m"] == pytest.approx(0, abs=1e-9)
    assert found["map_f_score_2cm"] == 1.0
    assert found["task_time_s"] == pytest.approx(1.0 + 5 / 30)
    assert found["mean_path_m"] == pytest.approx(0.5)
    assert [pair["merged"] for pair in found["pairs"]] == [False, True, True]
    assert not any(pair["wrong"] for pair in found["pairs"])
    alone = found["robots"][0]
    assert alone["map_recall_2cm"] == pytest.approx(1 / 3, abs=0.02)
    assert list(place_robots(3, {**merges, (0, 2): merged(None)})) == [0]


def test_a_bad_merge_is_called_wrong() -> None:
    team = exact_team(2)
    spec = multi_robot_run.MultiRobotSpec()
    off = team.true_pose(0, 1) @ make_pose(np.eye(3), [0.2, 0, 0])
    found = judge_team(team, {(0, 1): merged(off)}, spec)
    (pair,) = found["pairs"]
    assert pair["wrong"]
    assert pair["error_m"] == pytest.approx(0.2)
    assert found["team_ate_unaligned_m"] == pytest.approx(0.2 / np.sqrt(2))
    foreign = dataclasses.replace(spec, setting="foreign")
    found = judge_team(team, {(0, 1): merged(team.true_pose(0, 1))}, foreign)
    assert found["pairs"][0]["wrong"]  # another scene has no place in this one


def test_paths_of_a_team_share_what_they_see(box_scene, monkeypatch) -> None:
    path = HandheldPath(frames=12)
    paths, shared = team_paths(box_scene, path, 3, 2, 0.4)
    again, _ = team_paths(box_scene, path, 3, 2, 0.4)
    assert (len(paths), len(shared)) == (2, 1)
    assert shared[0] >= 0.4
    np.testing.assert_array_equal(paths, again)
    assert not np.allclose(paths[0], paths[1])
    assert overlap({(0,), (1,)}, {(1,), (2,), (3,)}) == 0.5
    monkeypatch.setattr(multi_robot_paths, "_ATTEMPTS", 2)
    with pytest.raises(InputError, match=r"shares 100 %"):
        team_paths(box_scene, path, 3, 2, 1.0)


def test_a_team_maps_its_paths_in_frames_of_its_own(box_scene, monkeypatch) -> None:
    monkeypatch.setattr(multi_robot_run.scenes, "make", lambda *_: box_scene)
    spec = multi_robot_run.MultiRobotSpec(frames=4, image_size="80x60", least_overlap=0.0)
    team = multi_robot_run.make_team(spec)
    for robot, truth in zip(team.robots, team.truths, strict=True):
        np.testing.assert_array_equal(robot.estimates[0], np.eye(4))
        assert robot.tracked.all()
        own = invert(truth[0]) @ truth
        np.testing.assert_allclose(robot.estimates, own, atol=0.03)
    assert box_scene.clearance(team.seen.astype(float)).max() < 1e-4


def test_the_command_reports_teams(robots, tmp_path, monkeypatch, capsys) -> None:
    def here(specs, run, *_):
        rows = []
        for spec in specs:
            rows.append({"spec": dataclasses.asdict(spec), "result": run(spec), "error": None})
        return rows

    def judged(points, *_):
        return {"f_score_2cm": 0.5, "f_score_5cm": 1.0, "map_points": len(points)}

    floor = np.zeros((1, 3))
    team = Team(robots, list(TRUTHS), [np.arange(10) / 30] * 2, floor, floor, [0.5])
    monkeypatch.setattr(multi_robot_run, "judge_map", judged)  # takes seconds, and is tested above
    monkeypatch.setattr(multi_robot, "run_all", here)
    monkeypatch.setattr(multi_robot, "make_team", lambda _: team)
    monkeypatch.setattr(multi_robot_run, "make_team", lambda _: team)
    monkeypatch.setattr(multi_robot_report, "CAMERA", multi_robot_report.CAMERA.scaled(0.125))
    options = ["--scenes", "table", "--merge.sources", "features", "--out", str(tmp_path)]
    assert multi_robot.main(options) == 0
    assert "| table | 1000 | shared | 2 of 2 |" in capsys.readouterr().out
    found = json.loads((tmp_path / "multi_robot.json").read_text())
    assert found["provenance"]["versions"]
    assert len(found["teams"][0]["robots"]) == 2
    assert found["summary"][0]["merged_same_scene"] == 1
    assert (tmp_path / "map_table_1000_2.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robots", "4"], r"robots = 4 is outside \[2, 3\]"),
        (["--settings", "apart"], "setting"),
        (["--scenes", "mars"], "unknown scene 'mars'"),
        (["--image-size", "1x1"], "unknown image size"),
        (["--noise", "loud"], "unknown noise model"),
        (["--seeds", "mine"], "unknown split"),
        (["--merge.patience", "1"], "patience = 1"),
        (["--merge.sources", "gps"], "unknown source of guesses 'gps'"),
        (["--least-overlap", "2"], "least_overlap = 2"),
    ],
)
def test_bad_input(options, message, tmp_path) -> None:
    with pytest.raises(InputError, match=message):
        multi_robot.main([*options, "--out", str(tmp_path)])


def test_frames_without_poses_are_refused(robots) -> None:
    with pytest.raises(InputError, match="10 frames but poses of shape"):
        dataclasses.replace(robots[1], estimates=robots[1].estimates[:3])
    none = {"frames": (), "estimates": np.zeros((0, 4, 4)), "tracked": np.zeros(0, dtype=bool)}
    with pytest.raises(InputError, match="without frames"):
        dataclasses.replace(robots[1], **none)
