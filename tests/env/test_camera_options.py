"""Options of the camera: any size and field of view, any noise model of the sensor."""

import numpy as np
import pytest

from ms_slam_env.camera import pinhole, xtion
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.sensor.noise import NOISE_MODELS, NoNoise, RangeNoise, noise_config

SCENE = {"scene": "table", "scene_seed": 0}


def test_without_a_field_of_view_it_is_the_xtions():
    assert pinhole("320x240") == xtion("320x240")
    own = 2 * np.degrees(np.arctan(320 / 570.3))
    assert pinhole("320x240", own).fx == pytest.approx(xtion("320x240").fx, rel=1e-12)


@pytest.mark.parametrize(("size", "angle"), [("64x96", 40.0), ("101x77", 90.0), ("640x480", 120.0)])
def test_the_edges_of_the_image_span_the_field_of_view(size, angle):
    camera = pinhole(size, angle)
    edges = np.array([[-0.5, camera.cy], [camera.width - 0.5, camera.cy]])
    left, right = camera.rays_at(edges)
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert np.degrees(np.arccos(cosine)) == pytest.approx(angle)
    assert f"{camera.width}x{camera.height}" == size
    assert camera.fx == camera.fy


@pytest.mark.parametrize("size", ["48x36", "101x77", "64x96"])
def test_an_environment_tracks_with_any_size(size):
    env = ActiveSlamEnv(image_size=size, field_of_view_deg=70, observation="rgbd", **SCENE)
    seen, _ = env.reset(seed=0)
    width, height = map(int, size.split("x"))
    assert seen["color"].shape == (height, width, 3)
    assert [env.step(action)[4]["tracking_ok"] for action in (0, 1, 2)] == [True] * 3


def test_noise_takes_every_model_with_its_strength():
    assert noise_config("range") == noise_config({"name": "range"}) == RangeNoise()
    off = noise_config({"strength": 0, "shadow": 0})
    assert (off.axial, off.lateral, off.shot, off.read, off.edge_dropout) == (0,) * 5
    twice = noise_config({"name": "kinect", "strength": 2, "read": 0.5})
    kinect = NOISE_MODELS["kinect"]
    assert (twice.axial, twice.shot, twice.read) == (2 * kinect.axial, 2 * kinect.shot, 0.5)
    assert noise_config({"strength": 100}).edge_dropout == 1
    assert noise_config({"name": "none", "strength": 5}) == NoNoise()


def depth_errors(noise):
    env = ActiveSlamEnv(noise=noise, **SCENE)
    env.reset(seed=0)
    frame, truth = env.episode.last_frame, env.camera_feed.true_depth()
    read = (frame.depth > 0) & (truth > 0)
    return np.median(np.abs(frame.depth[read] - truth[read]))


def test_stronger_noise_is_noisier_in_the_environment():
    none, kinect, strong = map(depth_errors, ("none", "kinect", {"strength": 3}))
    assert none < 1e-6
    assert kinect < 0.6 * strong
