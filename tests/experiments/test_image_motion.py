"""How camera and image move, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from ms_slam_experiments.difficulty import MOTIONS, by_second, contrast, frame_motion

from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.geometry import make_pose, so3_exp

K = xtion("160x120")
GAP_S = 0.1


def wall(distance_m: float) -> RGBDFrame:
    depth = np.full(K.shape, distance_m, np.float32)
    return RGBDFrame(np.zeros((*K.shape, 3), np.uint8), depth)


def test_a_roll_moves_the_image_as_its_rays_turn():
    angle = np.radians(2.0)
    motion = frame_motion(
        wall(2.0), np.eye(4), make_pose(so3_exp([0, 0, angle]), np.zeros(3)), K, GAP_S
    )
    found = dict(zip(MOTIONS, motion, strict=True))
    assert found["turn_deg_s"] == pytest.approx(20.0)
    assert found["speed_m_s"] == 0.0
    rays = K.rays()[::4, ::4].reshape(-1, 3)
    off_axis = np.linalg.norm(rays[:, :2], axis=1) / np.linalg.norm(rays, axis=1)
    chords = 2 * np.arcsin(off_axis * np.sin(angle / 2))
    assert found["image_motion_deg_s"] == pytest.approx(np.degrees(chords.mean()) / GAP_S, rel=1e-6)


def test_a_step_sideways_moves_near_things_more():
    step = make_pose(np.eye(3), [0.1, 0, 0])
    near, far = (frame_motion(wall(z), np.eye(4), step, K, GAP_S) for z in (1.0, 4.0))
    assert near[1] == far[1] == pytest.approx(1.0)
    assert near[2] > 3.5 * far[2]


def test_without_depth_the_image_motion_is_unknown():
    motion = frame_motion(wall(0.0), np.eye(4), np.eye(4), K, GAP_S)
    assert np.isnan(motion[2])
    assert not motion[:2].any()


def test_contrast_of_a_half_white_image():
    color = np.zeros((*K.shape, 3), np.uint8)
    color[:60] = 255
    assert contrast(RGBDFrame(color, np.ones(K.shape, np.float32))) == pytest.approx(127.5)


def test_rates_by_second_weigh_by_time():
    times, gaps = np.array([0.5, 0.9, 2.5, 2.9]), np.array([0.5, 0.4, 1.6, 0.4])
    seconds, rates = by_second(times, np.array([1.0, 0.8, 2.0, 2.0]), gaps)
    assert seconds == [0.5, 2.5]
    assert rates == pytest.approx([2.0, 2.0])
