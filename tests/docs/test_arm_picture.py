"""The arm in pictures: its triangles against MuJoCo's own ray casting, and the command."""

from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from ms_slam_docs import stills
from ms_slam_docs.stills import LABEL, Options, run_script, save, scene_with
from ms_slam_experiments.arm_masks import floor_below
from numpy.testing import assert_allclose

from ms_slam_env._runtime.output_files import check_out_folder
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import look_at, make_pose, so3_exp
from ms_slam_env.robot.arm import load_arm
from ms_slam_env.robot.arm.shape import arm_parts, column_parts
from ms_slam_env.sensor import RGBDSensor

SECOND_ARM = Path(__file__).parents[1] / "robot" / "second_arm.xml"
ARMS = {"mico": ("mico", "camera"), "second": (str(SECOND_ARM), "lens")}


@pytest.mark.parametrize("name", ARMS)
def test_depth_of_the_arm_is_mujocos(name, box_scene):
    arm = load_arm(*ARMS[name])
    T_world_base = make_pose(so3_exp([0, 0, 0.7]), [0.3, -0.2, 0.8])
    shown = scene_with(box_scene, arm_parts(arm, arm.home, T_world_base))
    camera = Intrinsics(80, 80, 39.5, 29.5, 80, 60)
    pose = look_at(np.array([1.3, 0.4, 1.4]), T_world_base[:3, 3] + [0, 0, 0.3])
    view = RGBDSensor(shown, camera, noise="none").ground_truth(pose)

    data = mujoco.MjData(arm.mj)
    data.qpos[:] = arm.mj.qpos0
    data.qpos[arm.qpos] = arm.home
    mujoco.mj_forward(arm.mj, data)
    T_base_camera = np.linalg.inv(T_world_base) @ pose
    geom = np.zeros(1, dtype=np.int32)
    expected = np.zeros(camera.shape)
    for v, u in np.ndindex(camera.shape):
        ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        length = np.linalg.norm(ray)
        direction = T_base_camera[:3, :3] @ ray / length
        hit = mujoco.mj_ray(arm.mj, data, T_base_camera[:3, 3], direction, None, 1, -1, geom)
        expected[v, u] = hit / length if hit >= 0 else 0

    is_arm = view.labels == shown.mesh.labels.index(LABEL)
    inside = cv2.erode((expected > 0).astype(np.uint8), np.ones((3, 3))) > 0
    outside = cv2.dilate((expected > 0).astype(np.uint8), np.ones((3, 3))) == 0
    assert inside.sum() > 100
    assert is_arm[inside].all()
    assert not is_arm[outside].any()
    apart = np.abs(view.depth[inside] - expected[inside])
    assert np.median(apart) < 0.001
    assert (apart < 0.01).mean() > 0.98  # edges between links fall into neighbouring pixels


def test_the_rest_of_the_scene_is_as_before(box_scene):
    arm = load_arm("mico")
    shown = scene_with(box_scene, arm_parts(arm, arm.home, np.eye(4)))
    camera = Intrinsics(40, 40, 19.5, 14.5, 40, 30)
    pose = look_at(np.array([1.0, 0.4, 1.4]), np.array([0, 0, 0.3]))
    without, with_arm = (
        RGBDSensor(scene, camera, noise="none").ground_truth(pose) for scene in (box_scene, shown)
    )
    is_arm = with_arm.labels == shown.mesh.labels.index(LABEL)
    assert is_arm.any()
    assert_allclose(with_arm.color[~is_arm], without.color[~is_arm])
    assert LABEL not in box_scene.mesh.labels


def test_column_stands_between_floor_and_base(box_scene):
    base = np.array([0.1, 0.2, 0.9])
    floor = floor_below(box_scene, base)
    corners = np.concatenate([part.corners.reshape(-1, 3) for part in column_parts(base, floor)])
    assert_allclose([corners[:, 2].min(), corners[:, 2].max()], [floor, 0.9], atol=1e-6)
    assert_allclose(corners[:, :2].mean(axis=0), base[:2], atol=1e-3)
    assert column_parts(base, 0.9) == []
    points, _ = box_scene.surface_points(0.02)
    below = points[np.linalg.norm(points[:, :2] - base[:2], axis=1) < 0.03]
    assert_allclose(floor, below[below[:, 2] < base[2], 2].max(), atol=0.02)


def test_command_writes_the_picture(tmp_path, monkeypatch, capsys):
    draw = lambda: stills.arm_picture({"carpet": 1004}, 1, 32)  # noqa: E731
    monkeypatch.setitem(stills.PICTURES, "arm", draw)
    words = ["arm", "--out", str(tmp_path / "deep")]
    assert run_script(Options, save, check_out_folder, words) == 0
    image = cv2.imread(str(tmp_path / "deep" / "arm.webp"))
    assert image.shape == (18 + 24 + 4, 3 * 36, 3)
    assert image[18:].std() > 5
    assert run_script(Options, save, check_out_folder, ["leg"]) == 2
    assert "unknown picture 'leg'; valid choices: scenes" in capsys.readouterr().err
