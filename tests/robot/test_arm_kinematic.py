"""The arm without physics: motions, frames, mask, state, and the environment with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ms_slam_env import scenes
from ms_slam_env._runtime.timings import Timings
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.geometry import look_at
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.robot.arm.arm import KinematicArm, camera_poses, frame_times
from ms_slam_env.robot.arm.clearance import LinkClearance
from ms_slam_env.robot.arm.controller import Controller

START = look_at([0.0, -0.8, 1.2], [1.2, 0.2, 0.7])
STEP_M, STEP_RAD = 0.12, np.radians(12)


SECOND_ARM = {"model": str(Path(__file__).with_name("second_arm.xml")), "camera_site": "lens"}


def make_arm(scene, **options):
    arm = KinematicArm(scene, ArmConfig(**options), STEP_M, STEP_RAD, Timings())
    arm.reset(START, np.random.default_rng(0))
    return arm


def random_walk(arm, steps, seed=0):
    draw = np.random.default_rng(seed)
    for _ in range(steps):
        action = int(draw.choice(np.flatnonzero(arm.action_masks())))
        yield action, arm.move(action)


@pytest.mark.parametrize("options", [{}, SECOND_ARM])
def test_possible_motions_are_made_exactly(box_scene, options):
    arm = make_arm(box_scene, **options)
    before = arm.T_world_camera
    np.testing.assert_allclose(before, START, atol=1e-9)
    for action, movement in random_walk(arm, 30):
        assert movement.made
        expected = before @ arm.candidate_motions()[action]
        np.testing.assert_allclose(movement.T_world_camera[-1], expected, atol=1e-7)
        np.testing.assert_array_equal(movement.T_world_camera[-1], arm.T_world_camera)
        np.testing.assert_array_equal(movement.T_world_camera, movement.T_world_camera_kinematic)
        assert arm.chain.within_limits(arm.q)
        before = arm.T_world_camera


def test_a_redundant_arm_goes_where_the_controller_would_send_it(box_scene):
    arm = make_arm(box_scene, **SECOND_ARM)
    for _ in range(12):
        action = int(np.flatnonzero(arm.action_masks())[-1])
        controller = Controller(arm.model, arm.chain, arm.clearance_field, arm.config)
        target = arm.chain.camera_pose(arm.q) @ arm.motions[action]
        plan = controller.plan(arm.q, target, float(arm.probe().duration_s[action]))
        arm.move(action)
        assert plan.followed
        np.testing.assert_allclose(arm.q, plan.q[-1], atol=0.02)


def test_frames_lie_on_the_way_at_the_cameras_rate(box_scene):
    arm = make_arm(box_scene, camera_hz=30.0)
    start = arm.T_world_camera.copy()
    action = int(np.flatnonzero(arm.action_masks()[7:])[0]) + 7  # one with a translation
    duration = arm.probe().duration_s[action]
    movement = arm.move(action)
    np.testing.assert_allclose(np.diff(movement.times_s, prepend=0.0), 1 / 30)
    assert 0 <= movement.times_s[-1] - duration < 1 / 30
    ahead = arm.motions[action, :3, 3]
    for T in movement.T_world_camera:
        local = (np.linalg.inv(start) @ T)[:3, 3]
        off = local - ahead * (local @ ahead) / (ahead @ ahead)
        assert np.linalg.norm(off) < 1.5e-3
    way = np.linalg.norm(movement.T_world_camera[:, :3, 3] - start[:3, 3], axis=1)
    assert (np.diff(way) >= -1e-6).all()
    fastest = np.diff(way, prepend=0.0).max() * 30
    assert fastest <= arm.config.speed_m_s * 1.02


def test_joints_keep_limits_and_speeds(box_scene):
    arm = make_arm(box_scene)
    for _ in range(10):
        probe, q = arm.probe(), arm.q.copy()
        action = int(np.flatnonzero(probe.ok)[-1])
        arm.move(action)
        assert arm.chain.within_limits(arm.q)
        assert (np.abs(arm.q - q) <= arm.chain.speed * probe.duration_s[action] + 1e-3).all()


def test_a_masked_motion_rests_for_one_frame(box_scene):
    arm = make_arm(box_scene)
    for _ in random_walk(arm, 40):
        if not arm.action_masks().all():
            break
    masked = int(np.flatnonzero(~arm.action_masks())[0])
    q = arm.q.copy()
    movement = arm.move(masked)
    assert not movement.made
    np.testing.assert_array_equal(arm.q, q)
    np.testing.assert_allclose(movement.times_s, [0.1])
    np.testing.assert_array_equal(movement.T_world_camera[0], arm.T_world_camera)


def test_standing_still_is_a_motion_of_one_frame(box_scene):
    arm = make_arm(box_scene)
    assert arm.action_masks()[0]
    movement = arm.move(0)
    assert movement.made
    np.testing.assert_allclose(movement.times_s, [0.1])


@pytest.mark.parametrize("count", [1, 5])
def test_a_chosen_number_of_frames_divides_the_motion(box_scene, count):
    arm = make_arm(box_scene, frames_per_action=count)
    action = int(np.flatnonzero(arm.action_masks())[-1])
    duration = arm.probe().duration_s[action]
    expected = arm.T_world_camera @ arm.motions[action]
    movement = arm.move(action)
    np.testing.assert_allclose(movement.times_s, duration * np.arange(1, count + 1) / count)
    np.testing.assert_allclose(movement.T_world_camera[-1], expected, atol=1e-7)
    assert len(arm.move(0).times_s) == count


def test_how_many_frames_a_motion_has_is_known_before_it_is_made(box_scene):
    arm = make_arm(box_scene, camera_hz=30.0)
    told = arm.frames_per_motion
    start = arm.get_state()
    made = []
    for action in np.flatnonzero(arm.action_masks())[1:]:
        arm.set_state(start)
        made.append(len(arm.move(int(action)).times_s))
    made.sort()
    assert made[0] < made[-1]
    assert made[(len(made) - 1) // 2] <= told <= made[len(made) // 2]
    assert told > 3
    assert make_arm(box_scene, frames_per_action=4).frames_per_motion == 4


@given(st.floats(0, 5), st.floats(0.1, 30), st.one_of(st.none(), st.integers(1, 50)))
def test_frames_are_regular_and_the_last_is_not_before_the_end(duration, hz, count):
    times = frame_times(duration, ArmConfig(camera_hz=hz, frames_per_action=count))
    assert len(times) >= 1
    period = np.diff(times, prepend=0.0)
    np.testing.assert_allclose(period, period[0])
    assert times[-1] >= duration - 1e-6
    if count is None:
        assert times[-1] <= max(duration, 1 / hz) + 1 / hz
        assert period[0] == pytest.approx(1 / hz)
    else:
        assert len(times) == count


def test_it_goes_on_bit_exactly_from_a_saved_state(box_scene):
    arm = make_arm(box_scene)
    for _ in random_walk(arm, 5):
        pass
    state = arm.get_state()
    rest = [(a, m) for a, m in random_walk(arm, 8, seed=3)]
    other = KinematicArm(box_scene, ArmConfig(), STEP_M, STEP_RAD, Timings())
    other.set_state(state)
    for (action, movement), (again, repeated) in zip(
        rest, random_walk(other, 8, seed=3), strict=True
    ):
        assert action == again
        np.testing.assert_array_equal(movement.T_world_camera, repeated.T_world_camera)
        np.testing.assert_array_equal(movement.times_s, repeated.times_s)


def test_the_mask_is_worked_out_once_a_place_and_given_as_a_copy(box_scene):
    arm = make_arm(box_scene)
    arm.timings.clear()
    arm.action_masks()[:] = False
    assert arm.action_masks().any()
    assert arm.timings.calls["mask"] == 1
    arm.move(0)
    arm.action_masks()
    assert arm.timings.calls["mask"] == 2


def test_the_environment_runs_with_it():
    env = ActiveSlamEnv("arm-kinematic", scene="wall", scene_seed=1000)
    _, info = env.reset(seed=0)
    draw = np.random.default_rng(0)
    for _ in range(5):
        before = info["T_world_camera"]
        action = int(draw.choice(np.flatnonzero(info["action_mask"])))
        _, _, terminated, _, info = env.step(action)
        expected = before @ env.embodiment.candidate_motions()[action]
        np.testing.assert_allclose(info["T_world_camera"], expected, atol=1e-7)
        assert info["tracking_ok"]
        assert not terminated
    assert len(env.episode.timestamps) > 6  # several frames a motion
    assert env.timings.calls["mask"] == 6


@pytest.fixture(scope="module")
def arm() -> KinematicArm:
    scene = scenes.make("table", 1000)
    arm = KinematicArm(scene, ArmConfig(), 0.12, 0.2, Timings())
    rng = np.random.default_rng(0)
    arm.reset(scene.sample_start(rng), rng)
    return arm


def test_poses_spread_from_where_the_arm_is(arm: KinematicArm) -> None:
    poses = camera_poses(arm, 150)
    np.testing.assert_allclose(poses[0], arm.T_world_camera, atol=1e-12)
    assert np.ptp(poses[:, :3, 3], axis=0).min() > 0.5
    assert (arm.scene.clearance(poses[:, :3, 3]) > 0).all()
    again = camera_poses(arm, 150)
    np.testing.assert_array_equal(again, poses)


def test_the_arm_reaches_motions_that_its_mask_allows(arm: KinematicArm) -> None:
    """What the mask allows lies within the space that the tree spans."""
    poses = camera_poses(arm)
    targets = (arm.T_world_camera @ arm.motions)[arm.action_masks()]
    apart = np.linalg.norm(targets[:, None, :3, 3] - poses[None, :, :3, 3], axis=2).min(axis=1)
    assert apart.max() < 0.25


def test_a_wall_around_the_arm_leaves_only_its_place(
    arm: KinematicArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def only_here(self: LinkClearance, q: np.ndarray) -> np.ndarray:
        return np.where(np.abs(q - arm.q).max(axis=1) < 1e-9, 0.0, -1.0)

    monkeypatch.setattr(LinkClearance, "least", only_here)
    assert len(camera_poses(arm, 20)) == 1
