"""``mask="map"``: what is possible by the robot's own occupancy grid, at its own estimate."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env
from ms_slam_env.camera import xtion
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at, make_pose
from ms_slam_env.planning import OccupancyGrid
from ms_slam_env.planning.occupancy_grid import FAR_M
from ms_slam_env.robot import FreeCamera
from ms_slam_env.robot.free_camera import CAMERA_RADIUS_M
from ms_slam_env.sensor import RGBDSensor

STEP_M, NEEDED_M = 0.12, CAMERA_RADIUS_M + 0.02
FORWARD, BACKWARD = 7 * 5, 7 * 6
CAMERA = xtion("80x60")


def make(env_id="MSActiveSLAM-FreeCamera-v0", **options):
    options = {"scene": "table", "scene_seed": 3, "image_size": "80x60", "mask": "map"} | options
    return gym.make(env_id, disable_env_checker=True, **options)


def camera(scene=None):
    return FreeCamera(scene, STEP_M, 0.2)


class Box:
    """Free space between walls at 0 and 2 m along every axis."""

    def clearance(self, points):
        return np.maximum(0, np.minimum(points, 2 - points).min(axis=1))


def test_in_a_box_motions_end_where_the_camera_has_room():
    rng = np.random.default_rng(0)
    for _ in range(200):
        eye = rng.uniform(0.02, 1.98, 3)
        T = look_at(eye, eye + rng.normal(size=3))
        x, y, z = T[:3, :3].T * STEP_M
        ends = eye + np.stack([0 * x, -y, y, -x, x, z, -z])
        box = Box()
        least = min(NEEDED_M, box.clearance(eye[None])[0])  # straight ways are nearest at an end
        expected = np.repeat(box.clearance(ends) >= least, 7)
        np.testing.assert_array_equal(camera().masks_in(box, T), expected)


def wall_at(depth_m):
    grid = OccupancyGrid()
    grid.integrate(np.full(CAMERA.shape, depth_m, np.float32), np.eye(4), CAMERA)
    return grid


def test_a_grid_says_how_far_the_next_occupied_cell_is():
    grid = wall_at(1.05)  # the middle of its cell
    depths = np.array([0.3, 0.6, 0.9, 1.05])
    points = np.stack([np.full(4, 0.05), np.full(4, 0.05), depths], axis=1)
    np.testing.assert_allclose(grid.clearance(points), [FAR_M, 0.45, 0.15, 0], atol=1e-9)
    np.testing.assert_array_equal(OccupancyGrid().clearance(points), np.full(4, FAR_M))


def test_what_was_touched_is_occupied_until_it_is_seen_free():
    grid = OccupancyGrid()
    point = np.array([0.05, 0.05, 0.55])
    for _ in range(2):
        grid.touch(point)
        assert grid.clearance(point[None])[0] < 1e-9
        for _ in range(4):
            grid.integrate(np.full(CAMERA.shape, 1.05, np.float32), np.eye(4), CAMERA)
        assert grid.clearance(point[None])[0] == FAR_M


@pytest.mark.parametrize(
    ("away_m", "goes_on"), [(0.25, True), (0.23, False), (0.05, False), (-0.15, True)]
)
def test_a_seen_wall_is_not_run_into_and_can_be_left(away_m, goes_on):
    T = make_pose(np.eye(3), np.array([0.05, 0.05, 1.05 - away_m]))
    mask = camera().masks_in(wall_at(1.05), T)
    assert mask[FORWARD] == goes_on
    assert np.delete(mask, np.arange(FORWARD, FORWARD + 7))[:FORWARD].all()


def test_it_agrees_with_the_truth_where_the_map_is_complete():
    scene = ms_slam_env.scenes.make("table", 3)
    sensor, grid, rng = RGBDSensor(scene, CAMERA, "none"), OccupancyGrid(), np.random.default_rng(1)
    for _ in range(12):
        eye = scene.sample_start(rng)[:3, 3]
        for aim in rng.normal(size=(25, 3)):
            T = look_at(eye, eye + aim)
            grid.integrate(sensor.capture(T, 0, 0.0, 0).depth, T, CAMERA)
    low, high = scene.bounds()
    places = rng.uniform(low, high, (20_000, 3))
    room = scene.clearance(places)
    both = np.zeros((2, 2), int)
    for eye in places[(room > 0.14) & (room < 0.4)][:200]:
        truth, T = camera(scene), look_at(eye, eye + rng.normal(size=3))
        truth.T_world_camera = T
        np.add.at(both, (truth.action_masks() * 1, truth.masks_in(grid, T) * 1), 1)
    assert both[0].sum() > 1000  # of 9800 motions, seven for each translation
    assert both.trace() > 0.9 * both.sum(), both
    assert both[0, 0] > 0.8 * both[0].sum(), both


@pytest.fixture(scope="module")
def with_its_back_to_a_wall():
    """An environment that has not seen the wall behind it, its info, and the pose there."""
    env = make(noise="none")
    scene, rng = ms_slam_env.scenes.make("table", 3), np.random.default_rng(0)
    truth = camera(scene)
    while True:
        truth.T_world_camera = scene.sample_start(rng)
        truth._masks = None
        for _ in range(30):  # back away as far as possible
            if not truth.action_masks()[BACKWARD]:
                break
            truth.move(BACKWARD)
        if not truth.action_masks()[BACKWARD] and truth.action_masks()[FORWARD]:
            break
    _, info = env.reset(seed=0, options={"T_world_camera": truth.T_world_camera})
    yield env, info, truth.T_world_camera
    env.close()


def test_what_was_not_seen_is_permitted_and_then_in_the_way(with_its_back_to_a_wall):
    env, info, T = with_its_back_to_a_wall
    assert info["action_mask"][BACKWARD]
    assert not env.unwrapped.embodiment.action_masks()[BACKWARD]
    observation, *_, info = env.step(BACKWARD)
    assert info["reward_terms"]["blocked"] == -0.1
    np.testing.assert_array_equal(info["T_world_camera"], T)
    np.testing.assert_array_equal(info["action_mask"], observation[-49:].astype(bool))
    assert not info["action_mask"][BACKWARD]  # it was felt


def test_what_the_map_forbids_is_not_made_even_if_it_could_be(with_its_back_to_a_wall):
    env, _, T = with_its_back_to_a_wall
    world = env.unwrapped
    env.reset(seed=0, options={"T_world_camera": T})
    assert world.embodiment.action_masks()[FORWARD]
    grid = world.episode.occupancy
    ahead = T[:3, 3] + 0.2 * T[:3, 2]
    grid.log_odds[tuple(grid.cells_of(ahead))] = 9
    world.simulation._known_mask = world.simulation._known_mask[0], None, 0
    assert not world.action_masks()[FORWARD]
    *_, info = env.step(FORWARD)
    assert info["reward_terms"]["blocked"] == -0.1
    np.testing.assert_array_equal(info["T_world_camera"], T)


def test_a_state_brings_its_mask_along():
    env, other = make(), make()
    env.reset(seed=1)
    for _ in range(4):
        env.step(FORWARD)
    other.reset(seed=2)
    other.unwrapped.load_state(env.unwrapped.save_state())
    np.testing.assert_array_equal(other.unwrapped.action_masks(), env.unwrapped.action_masks())
    plain = make(mask="true")
    with pytest.raises(InputError, match="saved with mask = 'map', which keeps an occupancy grid"):
        plain.unwrapped.load_state(env.unwrapped.save_state())


def test_an_arm_knows_its_joints_whatever_it_sees():
    env = make("MSActiveSLAM-v0", embodiment="arm-kinematic")
    env.reset(seed=1)
    arm, here = env.unwrapped.embodiment, env.unwrapped.episode.T_world_camera_estimate
    nowhere = arm.masks_in(OccupancyGrid(), here)
    assert not nowhere.all()
    assert nowhere[arm.action_masks()].all()
    boxed_in = OccupancyGrid()  # a wall just in front of the camera
    boxed_in.integrate(np.full(CAMERA.shape, 0.15, np.float32), here, CAMERA)
    known = arm.masks_in(boxed_in, here)
    assert known.sum() < nowhere.sum()
    assert nowhere[known].all()


@pytest.mark.parametrize(("given", "meant"), [("true", "true"), (True, "true"), ("map", "map")])
def test_the_names_of_the_option(given, meant):
    assert make(mask=given).unwrapped.config.mask == meant


def test_another_name_is_refused():
    with pytest.raises(InputError, match=r"mask 'maps'; valid choices: true, map"):
        make(mask="maps")
