"""The benchmark of loop closure: paths that come back, exact judgement, complete tables."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from ms_slam_experiments.loop_closure import LoopClosure, LoopSpec, judge_closure
from ms_slam_experiments.shared.loop_paths import returning_path

from ms_slam_env import scenes
from ms_slam_env.cli import main
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, relative_angle, so3_exp

SPEC = LoopSpec("living_room", 1002, "around", 0.06, 5.0, "kinect", "160x120", "deformation")


@pytest.mark.parametrize(("scene", "path"), [("living_room", "around"), ("corridor", "corridor")])
def test_paths_keep_their_limits_and_come_back(scene: str, path: str) -> None:
    world = scenes.make(scene, 1001)
    poses = returning_path(world, path, 1001, 0.05, 4.0)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = [
        relative_angle(a, b) for a, b in zip(poses[:-1, :3, :3], poses[1:, :3, :3], strict=True)
    ]
    assert steps.max() < 0.051
    assert max(turns) < np.radians(4.2)
    assert world.clearance(poses[:, :3, 3]).min() > 0.1
    later = poses[len(poses) // 2 :]
    back = [
        np.linalg.norm(T[:3, 3] - poses[0, :3, 3]) + relative_angle(T[:3, :3], poses[0, :3, :3])
        for T in later
    ]
    assert min(back) < 0.3
    np.testing.assert_array_equal(poses, returning_path(world, path, 1001, 0.05, 4.0))


def test_a_closure_is_judged_by_the_old_map() -> None:
    truth = np.stack([make_pose(so3_exp([0, 0.1 * k, 0]), [0.1 * k, 0, 0]) for k in range(64)])
    old_error = make_pose(np.eye(3), [0.0, 0.02, 0.0])
    ideal = old_error @ truth[63]
    drifted = make_pose(np.eye(3), [0.03, 0.0, 0.04]) @ ideal
    turned = ideal @ make_pose(so3_exp([0, np.radians(4.0), 0]), [0, 0, 0])
    past = np.arange(63, dtype=np.int32), old_error @ truth[:63]
    closure = judge_closure(63, past, truth, drifted, turned, 20)
    assert closure.before_m == pytest.approx(0.05)
    assert closure.before_deg == pytest.approx(0.0, abs=1e-6)
    assert closure.after_deg == pytest.approx(4.0)
    assert closure.is_wrong


def test_a_run_closes_its_loop() -> None:
    result = LoopClosure.run(SPEC)
    assert result["closures"]
    assert result["wrong_closures"] == 0
    assert result["lost_frames"] == 0
    assert result["final_ate_m"] < result["ate_m"]
    row = {"spec": asdict(SPEC), "result": result, "error": None}
    other = {"spec": {**asdict(SPEC), "closure": "none"}, "result": result, "error": None}
    medians, every = LoopClosure().tables([row, other])
    assert every.as_markdown().count("living_room:1002") == 2
    assert [line["loop_closure"] for line in medians.rows] == ["none", "deformation"]
    assert medians.rows[0]["ate_m"] == result["ate_m"]
    (chart,) = LoopClosure().charts([row, other])
    assert chart.panels[0].series[0].y == [result["ate_m"]]


def test_bad_recordings_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for text, message in (
        ("living_room:2000", "scene:seed:path"),
        ("living_room:2000:spiral:0.02:1:kinect", "spiral"),
        ("living_room:2000:around:0.02:1:loud", "loud"),
        ("living_room:x:around:0.02:1:kinect", "numbers"),
    ):
        command = ["experiment", "loop-closure", "--recordings", text, "--out", "/tmp/none"]
        assert main(command) == 2
        assert message in capsys.readouterr().err


def test_parameters_of_the_slam_reach_it_and_bad_ones_are_refused() -> None:
    specs = LoopClosure(options=("loops.window=70", "max_surfels=5000")).specs()
    assert specs[0].options == {"loops": {"window": 70}, "max_surfels": 5000}
    with pytest.raises(InputError, match="window"):
        LoopClosure(options=("loops.windows=70",)).specs()
