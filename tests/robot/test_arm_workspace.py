"""Where an arm can bring its camera: every pose must be one that the arm can hold there."""

from __future__ import annotations

import numpy as np
import pytest

from ms_slam_env import scenes
from ms_slam_env.robot.arm import ArmConfig
from ms_slam_env.robot.arm.arm import KinematicArm, camera_poses
from ms_slam_env.robot.arm.clearance import LinkClearance
from ms_slam_env.timings import Timings


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
