"""The picture of an episode: near hides far, everything fits in, plots are of what they say."""

import gymnasium as gym
import numpy as np
import pytest

import ms_slam_env  # noqa: F401 -- registers
from ms_slam_env.camera import Intrinsics
from ms_slam_env.env import rendering, third_person_view
from ms_slam_env.env.point_renderer import BACKGROUND, project, render_points
from ms_slam_env.geometry import look_at
from ms_slam_env.robot.arm import load_arm
from ms_slam_env.robot.arm.shape import arm_parts, surface_dots

CAMERA = Intrinsics(100, 100, 49.5, 49.5, 100, 100)


def plane(depth, spacing_m, half_m=0.3):
    x, y = np.meshgrid(*[np.arange(-half_m, half_m, spacing_m)] * 2)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)


@pytest.mark.parametrize("near_first", [True, False])
def test_a_near_surface_hides_a_far_one_whatever_the_order(near_first):
    near, far = plane(1.0, 0.03), plane(2.0, 0.01, half_m=0.9)
    red = np.tile(np.uint8([200, 0, 0]), (len(near), 1))
    blue = np.tile(np.uint8([0, 0, 200]), (len(far), 1))
    both = [(near, red, 0.03), (far, blue, 0.01)][:: 1 if near_first else -1]
    picture = render_points(
        CAMERA,
        np.eye(4),
        np.concatenate([points for points, _, _ in both]),
        np.concatenate([color for _, color, _ in both]),
        np.concatenate([np.full(len(points), dot) for points, _, dot in both]),
    )
    assert (
        picture[22:77, 22:77] == [200, 0, 0]
    ).all()  # without holes, though dots are 3 pixels apart
    assert (picture[10:15, 10:90] == [0, 0, 200]).all()


def test_small_gaps_are_closed_and_large_ones_are_not():
    points = plane(1.0, 0.01, half_m=0.45)
    across = np.abs(points[:, 0])
    points = points[(np.abs(across - 0.3) > 0.012) & (across > 0.1)]
    grey = np.full((len(points), 3), 90, np.uint8)
    row = render_points(CAMERA, np.eye(4), points, grey, np.full(len(points), 0.005))[50]
    assert (row[45:55] == BACKGROUND).all()
    assert (row[10:35] == 90).all()


def test_everything_that_must_be_seen_is_in_the_picture():
    rng = np.random.default_rng(0)
    for width, height in 10 * [(480, 480), (480, 400)]:
        camera = third_person_view.camera_of(width, height)
        start = look_at(rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3))
        points = rng.uniform(-1, 1, (500, 3)) * rng.uniform(0.3, 4, 3)
        must = start[:3, 3] + rng.uniform(-1, 1, (50, 3))
        pose = third_person_view.point_of_view(start[:3, 2], points, must, camera)
        pixels, depth = project(camera, pose, must)
        assert (depth > 0).all()
        last = [width - 1, height - 1]
        assert ((pixels > 0) & (pixels < last)).all()
        pixels, _ = project(camera, pose, points)
        assert ((pixels > 0) & (pixels < last)).all(axis=1).mean() > 0.95
        extent = np.ptp(np.concatenate([pixels, project(camera, pose, must)[0]]), axis=0).max()
        assert extent > 300


def test_dots_cover_an_arm_evenly():
    model = load_arm("mico")
    parts = arm_parts(model, model.home, np.eye(4))
    points, normals, colours = surface_dots(parts, 0.01)
    area = sum(
        0.5 * np.linalg.norm(np.cross(*np.moveaxis(np.diff(p.corners, axis=1), 1, 0)), axis=1).sum()
        for p in parts
    )
    assert len(points) == pytest.approx(area / 1e-4, rel=0.02)
    assert points.shape == normals.shape == colours.shape
    np.testing.assert_array_equal(points, surface_dots(parts, 0.01)[0])
    corners = np.concatenate([part.corners.reshape(-1, 3) for part in parts])
    np.testing.assert_allclose(points.min(axis=0), corners.min(axis=0), atol=0.02)
    np.testing.assert_allclose(points.max(axis=0), corners.max(axis=0), atol=0.02)


def test_the_plots_show_the_divergence_of_motions_beside_their_targets(monkeypatch):
    env = gym.make(
        "MSActiveSLAM-v0",
        scene="table",
        scene_seed=1000,
        render_mode="rgb_array",
        arm={"frames_per_action": 2},
    )
    _, info = env.reset(seed=0)
    expected = [info["divergence"]]
    for _ in range(2):
        action = int(np.flatnonzero(info["action_mask"])[-1])
        *_, info = env.step(action)
        expected.append(info["divergence"])
    plotted, plot = [], rendering._plot

    def record(values, target, top, title, unit):
        plotted.append((np.array(values), target, unit))
        return plot(values, target, top, title, unit)

    monkeypatch.setattr(rendering, "_plot", record)
    env.render()
    for column, target in enumerate(env.unwrapped.config.targets.divergence):
        values, aim, unit = plotted[column]
        np.testing.assert_array_equal(values, np.array(expected)[:, column])
        assert (aim, unit) == (target, "motions")
    np.testing.assert_array_equal(plotted[2][0], env.unwrapped.episode.pose_errors)
    assert len(plotted[2][0]) == 1 + 2 * 2
