"""A step may bring several frames, and the pose of a frame may come from several sources."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.embodiments import EMBODIMENTS, EmbodimentType
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert, make_pose, so3_exp
from ms_slam_env.metrics import ate_rmse
from ms_slam_env.robot import FreeCamera, MotionResult
from ms_slam_env.slam.surfel.localization import Localizer

OPTIONS = {"scene": "living_room", "scene_seed": 0, "step_m": 0.06, "step_rad": 0.06}
FRAMES = 3
DRIFT = make_pose(so3_exp(np.array([0.0, 0.002, 0.0])), np.array([0.004, 0.0, 0.0]))


class SlowCamera(FreeCamera):
    """Shows three frames on its way; its odometry drifts by 4 mm and 2 mrad a step."""

    def reset(self, T_world_camera, rng):
        super().reset(T_world_camera, rng)
        self.kinematic = np.eye(4)  # its own world frame, not the scene's

    @property
    def T_world_camera_kinematic(self):
        return self.kinematic

    def move(self, action):
        start = self.T_world_camera
        made = super().move(action).made
        between = [start @ motion(start, self.T_world_camera, k / FRAMES) for k in (1, 2)]
        poses = np.stack([*between, self.T_world_camera])
        kinematic = np.stack([self.kinematic @ invert(start) @ pose @ DRIFT for pose in poses])
        self.kinematic = kinematic[-1]
        return MotionResult(made, poses, kinematic, 0.1 * np.arange(1, FRAMES + 1), energy_j=2.0)


def motion(T_world_a, T_world_b, share):
    """Part of the way, good enough for small motions."""
    T = invert(T_world_a) @ T_world_b
    return make_pose(so3_exp(share * 0.5 * vee(T[:3, :3] - T[:3, :3].T)), share * T[:3, 3])


def vee(K):
    return np.array([K[2, 1], K[0, 2], K[1, 0]])


@pytest.fixture
def slow(monkeypatch):
    def build(scene, config, timings):
        return SlowCamera(scene, config.step_m, config.step_rad)

    monkeypatch.setitem(EMBODIMENTS, "slow", EmbodimentType(49, build, lambda config: None))
    return "slow"


def play(env, steps=4, seed=5):
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    infos = []
    for _ in range(steps):
        action = int(rng.choice(np.flatnonzero(env.action_masks())))
        infos.append(env.step(action)[-1])
    return infos


def test_every_frame_reaches_slam_and_is_counted(slow):
    env = ActiveSlamEnv(slow, **OPTIONS)
    tracked = []
    track = env.slam.track
    env.slam.track = lambda frame: tracked.append(frame) or track(frame)
    infos = play(env)
    assert len(tracked) == len(env.episode.trajectory_truth) == 1 + 4 * FRAMES
    np.testing.assert_allclose(env.episode.timestamps, 0.1 * np.arange(1 + 4 * FRAMES), atol=1e-12)
    assert [frame.timestamp for frame in tracked] == list(env.episode.timestamps)
    assert infos[-1]["time"] == pytest.approx(1.2)
    assert [info["energy"] for info in infos] == [2.0, 4.0, 6.0, 8.0]
    expected = ate_rmse(env.episode.trajectory_estimate, env.episode.trajectory_truth, align="none")
    assert infos[-1]["ate"] == pytest.approx(expected, rel=1e-9)
    np.testing.assert_array_equal(infos[-1]["T_world_camera"], env.episode.trajectory_truth[-1])


def test_divergence_of_a_step_compares_the_frames_at_its_ends(slow):
    env = ActiveSlamEnv(slow, observation="rgbd", **OPTIONS)
    env.reset(seed=5)
    first = env.episode.last_frame
    *_, info = env.step(7 * 5 + 6)
    measure = env.simulation.divergence
    both = [
        measure.histograms(grey(frame), frame.depth[None])
        for frame in (env.episode.last_frame, first)
    ]
    np.testing.assert_allclose(info["divergence"], measure.divergence(*both)[0], rtol=1e-12)
    assert len(env.episode.divergences) == 1 + FRAMES
    assert not np.allclose(env.episode.divergences[-1], info["divergence"])


def test_frames_within_a_step_need_not_be_compared(slow):
    """Observation, reward and info are the same; who asks for the rest hears what is missing."""
    every, few = (
        ActiveSlamEnv(slow, frame_divergences=measured, **OPTIONS) for measured in (True, False)
    )
    (seen, _), (seen_by_few, _) = every.reset(seed=5), few.reset(seed=5)
    np.testing.assert_array_equal(seen, seen_by_few)
    for action in (7 * 5 + 6, 0, 7 * 6):
        observation, reward, *_, info = every.step(action)
        observation_of_few, reward_of_few, *_, info_of_few = few.step(action)
        np.testing.assert_array_equal(observation, observation_of_few)
        assert reward == reward_of_few
        np.testing.assert_array_equal(info["divergence"], info_of_few["divergence"])
    assert info["divergence"].all()
    with pytest.raises(InputError, match="needs frame_divergences=True"):
        _ = few.episode.divergences
    twin = ActiveSlamEnv(slow, frame_divergences=False, **OPTIONS)
    twin.reset(seed=1)
    twin.load_state(few.save_state())
    np.testing.assert_array_equal(twin.step(3)[0], few.step(3)[0])


def grey(frame):
    from ms_slam_env.camera import intensity_image

    return intensity_image(frame.color)[None].astype(np.float32)


def test_ground_truth_pose_leaves_no_error(slow):
    env = ActiveSlamEnv(slow, pose="ground_truth", **OPTIONS)
    infos = play(env)
    assert infos[-1]["ate"] == 0
    assert all(info["tracking_ok"] for info in infos)
    assert len(env.slam.map_points()) > 1000


def test_kinematic_pose_is_the_odometry_tied_to_the_start(slow):
    env = ActiveSlamEnv(slow, pose="kinematics", **OPTIONS)
    infos = play(env)
    np.testing.assert_allclose(env.episode.trajectory_estimate, env.episode.trajectory_kinematics)
    np.testing.assert_allclose(
        env.episode.trajectory_kinematics[0], env.episode.trajectory_truth[0]
    )
    # The drift of three frames a step is added up: nothing looks at the images.
    assert 0.004 < infos[-1]["pose_error"] < 0.2
    assert infos[-1]["pose_error"] > infos[0]["pose_error"]


def test_kinematic_guess_saves_a_jump_that_tracking_loses(monkeypatch):
    def exact(scene, config, timings):  # without an arm, and its kinematics without an error
        return FreeCamera(scene, config.step_m, config.step_rad)

    # Features would find the jump alone.
    monkeypatch.setattr(Localizer, "_search_by_features", lambda self, alignment, frames: alignment)
    monkeypatch.setitem(EMBODIMENTS, "exact", EmbodimentType(49, exact, lambda config: None))
    big = {**OPTIONS, "step_m": 0.4, "step_rad": 0.5}
    errors = {}
    for pose in ("slam", "slam-kinematics"):
        env = ActiveSlamEnv("exact", pose=pose, **big)
        infos = play(env, steps=6, seed=2)
        errors[pose] = infos[-1]["ate"]
    assert errors["slam-kinematics"] < 0.03
    assert errors["slam"] > 3 * errors["slam-kinematics"]


def test_unknown_pose_source_lists_the_choices():
    with pytest.raises(InputError, match=r"unknown EnvConfig\.pose 'gps'; valid choices: slam, sl"):
        ActiveSlamEnv("free", pose="gps", **OPTIONS)


def test_an_embodiment_that_cannot_start_says_why(monkeypatch):
    class Stuck(FreeCamera):
        def reset(self, T_world_camera, rng):
            raise UnreachableError("the arm is in its box")

    def build(scene, config, timings):
        return Stuck(scene, 0.1, 0.1)

    monkeypatch.setitem(EMBODIMENTS, "stuck", EmbodimentType(49, build, lambda config: None))
    env = ActiveSlamEnv("stuck", **OPTIONS)
    with pytest.raises(InputError, match="can be used, the last: the arm is in its box"):
        env.reset(seed=0)
    with pytest.raises(InputError, match="reset option T_world_camera: the arm is in its box"):
        env.reset(seed=0, options={"T_world_camera": np.eye(4)})
    with pytest.raises(InputError, match="must be reset"):
        env.step(0)


@pytest.mark.parametrize("embodiment", ["free", "fixed-translation"])
def test_a_free_camera_takes_its_frames_on_the_way(embodiment):
    alone = ActiveSlamEnv(embodiment, **OPTIONS)
    env = ActiveSlamEnv(embodiment, frames_per_action=4, **OPTIONS)
    for one in (alone, env):
        one.reset(seed=3)
    for action in (5, 3, 6):
        alone.step(action)
        info = env.step(action)[-1]
    truth = np.array(env.episode.trajectory_truth)
    assert info["time"] == pytest.approx(12 / 30)
    np.testing.assert_array_equal(truth[::4], alone.episode.trajectory_truth)
    way = invert(truth[:-1]) @ truth[1:]
    for leg in way.reshape(3, 4, 4, 4):
        turns = [Rotation.from_matrix(T[:3, :3]).as_rotvec() for T in leg]
        np.testing.assert_allclose(turns, np.tile(turns[0], (4, 1)), atol=1e-9)
    steps = np.diff(truth[:, :3, 3], axis=0).reshape(3, 4, 3)
    np.testing.assert_allclose(steps, np.repeat(steps[:, :1], 4, axis=1), atol=1e-9)


def test_the_arm_has_an_option_of_its_own_for_frames():
    with pytest.raises(InputError, match=r"arm\.frames_per_action"):
        ActiveSlamEnv("arm", frames_per_action=2)


def test_frames_energy_and_timings_of_the_arm_are_counted():
    options = {"scene": "table", "scene_seed": 0, "arm": {"frames_per_action": 2}}
    env = ActiveSlamEnv("arm", **options)
    infos = play(env, seed=1)
    assert len(env.episode.trajectory_truth) == 1 + 4 * 2
    assert (np.diff([info["energy"] for info in infos]) > 0).all()
    assert {"ik", "physics", "mask", "move", "slam", "render"} <= set(env.timings.total)
    off = np.linalg.norm(
        env.episode.trajectory_truth[:, :3, 3] - env.episode.trajectory_kinematics[:, :3, 3], axis=1
    )
    assert off[0] < 1e-12
    assert 0 < off[-1] < 0.03
