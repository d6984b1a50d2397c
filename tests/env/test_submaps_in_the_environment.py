"""A lost camera goes on in a submap: what the environment says of it, and when it gives up."""

import gymnasium as gym
import numpy as np
import pytest

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.env.episode import Episode
from ms_slam_env.geometry import invert, make_pose, so3_exp
from ms_slam_env.slam import TrackResult

OPTIONS = {
    "scene": "living_room",
    "split": "validation",
    "step_m": 0.03,
    "step_rad": 0.05,
    "slam_config": {"submaps": "atlas", "submap_rules": {"after": 2}},
    "away_patience": 6,
}
AWAY = make_pose(so3_exp([0.0, np.pi, 0.0]), np.zeros(3))  # the other way, about the camera's down


@pytest.fixture
def env(monkeypatch):
    """The camera that the sensor looks through is turned round after two steps."""
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **OPTIONS)
    env.reset(seed=3)
    for _ in range(2):
        env.step(1)
    kind = type(env.unwrapped.sensor)
    capture = kind.capture

    def turned(self, T_world_camera, *rest, **options) -> RGBDFrame:
        return capture(self, T_world_camera @ AWAY, *rest, **options)

    monkeypatch.setattr(kind, "capture", turned)
    yield env
    env.close()


def test_a_submap_is_tracked_unsurely_until_patience_ends(env):
    records = [env.step(1) for _ in range(6)]
    infos = [info for *_, info in records]
    assert [info["tracking_ok"] for info in infos] == [False] + [True] * 5
    assert [info["submap"] for info in infos] == [0] + [1] * 5
    assert not np.isfinite(infos[0]["pose_covariance"]).all()
    sure = 0.01**2  # m^2; a guess is less sure
    assert all(np.trace(info["pose_covariance"][:3, :3]) > sure for info in infos[1:])
    assert [terminated for _, _, terminated, _, _ in records] == [False] * 5 + [True]
    assert infos[0]["reward_terms"]["lost"] < 0 == infos[1]["reward_terms"]["lost"]
    assert infos[-1]["reward_terms"]["lost_for_good"] < 0


def test_a_state_saved_in_a_submap_goes_on_bit_exactly(env):
    for _ in range(3):
        env.step(1)
    assert env.unwrapped.episode.frames[-1].submap == 1
    state = env.unwrapped.save_state()
    expected = env.step(9)
    again = gym.make("MSActiveSLAM-FreeCamera-v0", **OPTIONS)
    again.reset(seed=8)
    again.unwrapped.load_state(state)
    found = again.step(9)
    np.testing.assert_array_equal(found[0], expected[0])
    assert found[1:4] == expected[1:4]
    for key in ("T_world_camera_estimate", "pose_covariance", "submap"):
        np.testing.assert_array_equal(found[4][key], expected[4][key])


def test_kinematic_motion_adds_up_while_tracking_is_lost():
    """The guess that the arm's joints give is counted from the last frame that was tracked."""
    rng = np.random.default_rng(0)
    poses = [make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(4)]
    frame = RGBDFrame(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32))
    episode = Episode("box", 0, 0)
    for k, pose in enumerate(poses[:3]):
        seen = episode.observe(frame, pose, pose, float(k))
        held = poses[0] if k else pose  # lost from the second frame on
        episode.record(seen, TrackResult(held, k == 0), np.zeros(2))
    seen = episode.observe(frame, poses[3], poses[3], 3.0)
    np.testing.assert_array_equal(seen.T_world_previous_estimate, poses[0])
    motion = seen.T_previous_camera_kinematic
    np.testing.assert_allclose(motion, invert(poses[0]) @ poses[3], atol=1e-12)
