"""The arm with physics as an embodiment: what it reaches, reports and repeats."""

import numpy as np
import pytest
from box_scene import BoxScene
from numpy.testing import assert_allclose, assert_array_equal

from ms_slam_env._runtime.timings import Timings
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.robot.arm import ArmConfig, ArmNoise
from ms_slam_env.robot.arm.dynamic_arm import DynamicArm

PERFECT = ArmNoise(0, 0, 0, 0, 0, 0)
STEP = (0.08, np.radians(8))


SCENE = BoxScene(seed=0)


def make_arm(seed=0, scene=SCENE, **options):
    arm = DynamicArm(scene, ArmConfig(**options), *STEP, Timings())
    rng = np.random.default_rng(seed)
    arm.reset(scene.sample_start(rng), rng)
    return arm


@pytest.fixture(scope="module")
def saved():
    arm = make_arm()
    return arm, arm.get_state()


@pytest.fixture
def arm(saved):
    arm, state = saved
    arm.set_state(state)
    return arm


def possible(arm, rng):
    return int(rng.choice(np.flatnonzero(arm.action_masks()[1:])) + 1)


def commanded(arm):
    return arm.T_world_base @ arm.chain.camera_pose(arm.q_command)


def apart(T_a, T_b):
    return np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]), relative_angle(T_a[:3, :3], T_b[:3, :3])


def same(a, b):
    for name in ("T_world_camera", "T_world_camera_kinematic", "times_s", "energy_j", "made"):
        assert_array_equal(getattr(a, name), getattr(b, name), name)


def test_it_ends_close_to_where_it_was_sent(arm):
    rng = np.random.default_rng(1)
    for _ in range(15):
        action = possible(arm, rng)
        target = commanded(arm) @ arm.motions[action]
        movement = arm.move(action)
        assert movement.made
        off_m, off_rad = apart(commanded(arm), target)
        assert off_m < 0.002  # of the command
        assert off_rad < np.radians(0.2)
        off_m, off_rad = apart(movement.T_world_camera[-1], target)
        assert 1e-5 < off_m < 0.012  # of the arm
        assert 1e-5 < off_rad < np.radians(1.2)
        assert_array_equal(movement.T_world_camera[-1], arm.T_world_camera)
        assert movement.energy_j > 0.01


def test_joint_sensors_are_off_by_a_bias_that_stays(arm):
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(20):
        movement = arm.move(possible(arm, rng))
        assert_array_equal(movement.T_world_camera_kinematic[-1], arm.T_world_camera_kinematic)
        errors += list(invert(movement.T_world_camera) @ movement.T_world_camera_kinematic)
    offsets = np.array(errors)[:, :3, 3]
    assert 0.0005 < np.linalg.norm(offsets, axis=1).mean() < 0.02
    assert np.linalg.norm(np.mean(offsets, axis=0)) > 2 * offsets.std(axis=0).max()


def test_a_perfect_arm_knows_where_it_is_and_still_sags():
    arm = make_arm(noise=PERFECT)
    off = arm.T_world_camera[:3, 3] - commanded(arm)[:3, 3]
    assert -0.006 < off[2] < -1e-4
    rng = np.random.default_rng(3)
    for _ in range(4):
        movement = arm.move(possible(arm, rng))
        assert_allclose(movement.T_world_camera, movement.T_world_camera_kinematic, atol=1e-12)


def test_frames_arrive_while_it_moves(arm):
    action = int(np.flatnonzero(arm.action_masks())[-1])
    movement = arm.move(action)
    assert len(movement.times_s) >= 3
    assert_allclose(np.diff(movement.times_s), 0.1, atol=arm.dynamics.timestep_s)
    way = np.linalg.norm(np.diff(movement.T_world_camera[:, :3, 3], axis=0), axis=1)
    assert (way[:-2] > 0.001).all()


@pytest.mark.parametrize("frames", [1, 4])
def test_the_number_of_frames_can_be_given(frames):
    arm = make_arm(frames_per_action=frames)
    action = int(np.flatnonzero(arm.action_masks())[-1])
    moved, rested = arm.move(action), arm.move(0)
    assert moved.T_world_camera.shape == rested.T_world_camera_kinematic.shape == (frames, 4, 4)
    assert moved.times_s[-1] > 0.3
    assert_allclose(rested.times_s, 0.1 * np.arange(1, frames + 1), atol=1e-9)


def test_a_masked_motion_is_not_made(arm):
    rng = np.random.default_rng(0)
    while arm.action_masks().all():
        arm.move(possible(arm, rng))
    for _ in range(2):  # what is left of the motion before ends in the first
        before, command = arm.T_world_camera.copy(), arm.q_command.copy()
        movement = arm.move(int(np.flatnonzero(~arm.action_masks())[0]))
        assert not movement.made
        assert_array_equal(arm.q_command, command)
    assert apart(arm.T_world_camera, before)[0] < 2e-4
    assert movement.energy_j < 0.01


def test_equal_seeds_are_bit_identical():
    first, second = make_arm(5), make_arm(5)
    other = make_arm(6)
    rng = np.random.default_rng(0)
    for _ in range(4):
        action = possible(first, rng)
        same(first.move(action), second.move(action))
        assert_array_equal(first.action_masks(), second.action_masks())
    assert (other.T_world_camera_kinematic != first.T_world_camera_kinematic).any()


def test_a_restored_arm_goes_on_bit_exactly(arm):
    rng = np.random.default_rng(4)
    for _ in range(2):
        arm.move(possible(arm, rng))
    state = arm.get_state()
    actions, went = [], []
    for _ in range(5):
        actions.append(possible(arm, rng))
        went.append(arm.move(actions[-1]))
    elsewhere = make_arm(9)
    for again in (arm, elsewhere):
        again.set_state(state)
        for action, movement in zip(actions, went, strict=True):
            same(again.move(action), movement)


def test_an_attempt_changes_nothing_and_foretells_the_move(arm):
    state = arm.get_state()
    for action in (0, 9, 30, 48):
        probe = arm.probe()
        attempt = arm.attempt(action)
        assert arm.probe() is probe
        assert_array_equal(arm.q_command, state["q_command"])
        assert_array_equal(arm.dynamics.state, state["physics"])
        if probe.ok[action]:
            assert arm.move(action).made == attempt.reached
            assert_allclose(apart(arm.T_world_camera, commanded(arm))[0], attempt.error_m)
            arm.set_state(state)


def test_the_mask_tells_what_can_be_done(arm):
    rng = np.random.default_rng(6)
    agree = []
    for _ in range(3):
        for _ in range(5):
            arm.move(possible(arm, rng))
        mask = arm.action_masks()
        agree += [arm.attempt(action).reached == mask[action] for action in range(49)]
    assert np.mean(agree) >= 0.99


class Surprise(BoxScene):
    """A room in which a ball appears after the arm has looked around."""

    ball = None

    def clearance(self, points):
        free = super().clearance(points)
        if self.ball is None:
            return free
        centre, radius = self.ball
        return np.clip(np.linalg.norm(points - centre, axis=1) - radius, 0, free)


def test_it_stops_at_furniture_that_it_did_not_expect():
    scene = Surprise(seed=0)
    arm = make_arm(scene=scene, noise=PERFECT)
    action = next(a for a in range(48, 0, -1) if arm.action_masks()[a])
    state = arm.get_state()
    free = arm.attempt(action)
    assert free.reached
    last = np.flatnonzero(arm.chain.capsule_link > 0)[-1]
    start, end = (arm.chain.capsules(q)[last].mean(axis=0) for q in (arm.q, free.q[-1]))
    along = (end - start) / np.linalg.norm(end - start)
    radius = float(arm.chain.capsule_radius[last])
    ball = end + 0.02 * along
    scene.ball = (arm.T_world_base[:3, :3] @ ball + arm.T_world_base[:3, 3], 0.02 + radius / 2)
    assert arm.attempt(action).stopped
    stopped = arm.move(action)
    assert not stopped.made
    scene.ball = None
    arm.set_state(state)
    made = arm.move(action)
    assert made.made
    ways = [apart(m.T_world_camera[-1], state["T_world_camera"])[0] for m in (stopped, made)]
    assert ways[0] < ways[1] - 0.005
