"""Perturbations in the environment: the same as in sequences, seen by SLAM and the agent."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ms_slam_env
import ms_slam_env.scenes
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.wrappers import Perturbed
from ms_slam_env.errors import InputError
from ms_slam_env.sequences import (
    PERTURBATIONS,
    PoseInterpolation,
    make_perturbation,
    render_sequence,
)
from ms_slam_env.sequences.perturbations import POINT
from ms_slam_env.sequences.perturbed_camera import Imperfections, PerturbedCamera

OPTIONS = {
    "scene": "living_room",
    "scene_seed": 0,
    "image_size": "80x60",
    "pose": "ground_truth",
    "step_m": 0.03,
    "step_rad": 0.05,
}
ACTIONS = (35, 6, 12, 36)
ONLINE = tuple(name for name in PERTURBATIONS if name != "fast-motion")
STRONG = {
    "black-frames": {"start": 2, "length": 2},
    "exposure-jumps": {"every": 2},
    "moving-objects": {"count": 1},
}


def perturbed(*names, **options):
    env = ActiveSlamEnv("free", **{**OPTIONS, **options})
    for name in names:
        env = Perturbed(env, name, **STRONG.get(name, {}))
    return env


def play(env, seed=3, actions=ACTIONS):
    """The frames, observations and rewards of an episode."""
    record = [env.reset(seed=seed)[0]]
    frames = [env.unwrapped.episode.last_frame]
    for action in actions:
        observation, reward, *_, info = env.step(action)
        record.append((observation, reward, info))
        frames.append(env.unwrapped.episode.last_frame)
    return frames, record


def assert_same(a, b):
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth, other.depth)
        assert one.timestamp == other.timestamp


@pytest.fixture(scope="module")
def plain():
    """The frames without perturbation."""
    return play(perturbed())[0]


@pytest.mark.parametrize("name", [n for n in ONLINE if n not in ("moving-objects", "illumination")])
def test_frames_are_those_of_a_rendered_sequence(name, plain) -> None:
    env = perturbed(name)
    frames, _ = play(env)
    inner = env.unwrapped
    path = PoseInterpolation(inner.episode.timestamps, inner.episode.trajectory_truth)
    perturbation = make_perturbation(name, STRONG.get(name))
    seed = inner.camera_feed.get_state()["noise_seed"]
    camera = PerturbedCamera(
        inner.scene, inner.intrinsics, inner.config.noise, Imperfections.of([perturbation])
    )

    def brightness():
        return np.array(
            [camera.brightness(T, t) for T, t in zip(path.poses, path.times_s, strict=True)]
        )

    changed = 0
    for k, frame in enumerate(frames):
        if not inner.episode.processed[k]:
            assert name == "frame-skipping"
            assert k % 2 == 1
            np.testing.assert_array_equal(frame.color, frames[k - 1].color)
            continue
        # The agent has not moved on yet: after the last pose the motion goes on.
        so_far = PoseInterpolation(path.times_s[: k + 1], path.poses[: k + 1])
        expected = camera.take(so_far, path.times_s[k], k, 151, seed, brightness)
        assert_same([frame], [expected])
        changed += not np.array_equal(frame.color, plain[k].color)
        changed += not np.array_equal(frame.depth, plain[k].depth)
    assert changed or name == "frame-skipping"


def test_without_strength_nothing_changes(plain) -> None:
    env = Perturbed(ActiveSlamEnv("free", **OPTIONS), "motion-blur", exposure_s=0.0)
    env = Perturbed(env, "moving-objects", count=0)
    env = Perturbed(env, "illumination", dim=0.0, lamp=0.0)
    env = Perturbed(env, "frame-skipping", keep_every=1)
    assert_same(play(env)[0], plain)


def test_moving_objects_and_light_are_the_same_for_the_same_seed(plain) -> None:
    names = ("moving-objects", "illumination", "rolling-shutter")
    env = perturbed(*names)
    frames, record = play(env)
    again, other = play(perturbed(*names))
    assert_same(frames, again)
    for (a, reward_a, _), (b, reward_b, _) in zip(record[1:], other[1:], strict=True):
        assert reward_a == reward_b
        np.testing.assert_array_equal(a, b)
    (mover, *_) = env.unwrapped.camera_feed.movers
    assert mover.name == "box 0"
    assert not np.array_equal(frames[0].depth, plain[0].depth)
    assert not np.array_equal(frames[0].color, frames[-1].color)
    # A second episode of the same environment has other ways.
    before = mover.pose(0.0)
    env.reset(seed=4)
    assert not np.array_equal(env.unwrapped.camera_feed.movers[0].pose(0.0), before)


def test_a_frame_that_is_not_delivered_changes_neither_map_nor_estimate() -> None:
    env = Perturbed(ActiveSlamEnv("free", **{**OPTIONS, "pose": "slam"}), "frame-skipping")
    env.reset(seed=3)
    inner = env.unwrapped
    before, estimate = inner.slam.surface_points().copy(), inner.episode.trajectory_estimate[-1]
    *_, info = env.step(35)
    np.testing.assert_array_equal(inner.slam.surface_points(), before)
    np.testing.assert_array_equal(info["T_world_camera_estimate"], estimate)
    assert not np.array_equal(info["T_world_camera"], estimate)
    assert info["pose_error"] == pytest.approx(0.03, abs=1e-6)
    np.testing.assert_array_equal(info["divergence"], 0.0)
    env.step(35)
    assert inner.episode.processed.tolist() == [True, False, True]


def test_what_moves_waits_for_the_camera_and_is_not_new_surface() -> None:
    env = perturbed("moving-objects")
    env.reset(seed=3)
    inner = env.unwrapped
    mover = inner.camera_feed.movers[0]
    T = inner.episode.trajectory_truth[-1].copy()
    T[:3, 3] = mover.middle(0.1)
    before = mover.pose(0.05)
    inner.camera_feed.set_trajectory(np.array([0.05, 0.1]), np.stack([T, T]))
    np.testing.assert_allclose(mover.pose(0.1), before, atol=1e-12)
    truth = inner.camera_feed._camera.sensor.ground_truth(inner.episode.trajectory_truth[-1], 0.0)
    moving = truth.labels >= len(inner.scene.mesh.labels)
    inner.camera_feed.set_trajectory(np.zeros(1), inner.episode.trajectory_truth)
    inner.camera_feed.capture(inner.episode.trajectory_truth[-1], 0, 0.0)
    depth = inner.camera_feed.true_depth()
    np.testing.assert_array_equal(depth[moving], 0)
    np.testing.assert_array_equal(depth[~moving], truth.depth[~moving])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("fog", {}, "unknown perturbation 'fog'"),
        ("motion-blur", {"exposure": 1.0}, "exposure_s"),
        ("motion-blur", {"exposure_s": -1.0}, "exposure_s"),
        ("fast-motion", {}, "the agent moves the camera"),
    ],
)
def test_bad_perturbations_are_refused(name, options, message) -> None:
    with pytest.raises(InputError, match=message):
        Perturbed(ActiveSlamEnv("free", **OPTIONS), name, **options)


@pytest.mark.parametrize("strength", [0.5, "x", [1], {7: 1}])
def test_a_strength_that_is_no_mapping_is_refused(strength) -> None:
    with pytest.raises(InputError, match="must be a mapping of options of motion-blur"):
        gymnasium.make("MSActiveSLAM-FreeCamera-MotionBlur-v0", perturbation=strength, **OPTIONS)


def test_other_environments_are_refused() -> None:
    with pytest.raises(InputError, match="not CartPole"):
        Perturbed(gymnasium.make("CartPole-v1"), "motion-blur")


# ---------------------------------------------------------------- ids


@pytest.mark.parametrize("scene", ["window", "table", "wall", "carpet"])
def test_things_move_where_nothing_fits_between_camera_and_table(scene: str) -> None:
    env = gymnasium.make(
        "MSActiveSLAM-FreeCamera-MovingObjects-v0", scene=scene, scene_seed=1, image_size="64x48"
    )
    env.reset(seed=0)
    movers = env.unwrapped.camera_feed.movers  # type: ignore[attr-defined]
    assert len(movers) == 2
    start = env.unwrapped.episode.trajectory_truth[:1, :3, 3]  # type: ignore[attr-defined]
    assert all(mover.distance(start, np.zeros(1))[0] >= 0.35 for mover in movers)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ms_slam_env.scenes.SCENES)
def test_every_id_begins_in_every_scene(scene: str) -> None:
    number = list(ms_slam_env.scenes.SCENES).index(scene)
    moving = [one for one in ms_slam_env.PERTURBED_ENV_IDS if "MovingObjects" in one]
    others = [one for one in ms_slam_env.PERTURBED_ENV_IDS if one not in moving]
    in_turn = others[number :: len(ms_slam_env.scenes.SCENES)]  # what a scene has no part in
    for env_id in (*ms_slam_env.ENV_IDS, *ms_slam_env.TASK_IDS, *moving, *in_turn):
        env = gymnasium.make(env_id, scene=scene, scene_seed=1, image_size="40x32")
        for seed in range(2 if scene in ms_slam_env.scenes.ROOMS else 1):
            _, info = env.reset(seed=seed)
            assert (info["scene"], info["tracking_ok"]) == (scene, True), (env_id, seed)
        env.close()


def test_it_takes_effect_at_the_next_reset() -> None:
    env = ActiveSlamEnv("free", **OPTIONS)
    env.reset(seed=1)
    late = Perturbed(env, "black-frames")
    for use in (lambda: late.step(0), env.save_state):
        with pytest.raises(InputError, match=r"call env.reset\(\) first"):
            use()
    late.reset(seed=1)
    late.step(0)


def test_every_perturbation_has_an_id() -> None:
    ids = ms_slam_env.PERTURBED_ENV_IDS
    assert len(ids) == 2 * len(ONLINE) + 1
    for env_id in ids:
        keywords = gymnasium.spec(env_id).kwargs
        assert keywords["perturbed_by"] in PERTURBATIONS
    assert {gymnasium.spec(i).kwargs["perturbed_by"] for i in ids} == set(PERTURBATIONS)


@pytest.mark.parametrize(
    "env_id", [*ms_slam_env.PERTURBED_ENV_IDS[::4], ms_slam_env.PERTURBED_ENV_IDS[-1]]
)
def test_ids_can_be_made(env_id) -> None:
    env = gymnasium.make(env_id, image_size="80x60")
    assert env.action_space.n == 49
    perturbations = env.unwrapped.camera_feed.perturbations
    if "FastMotion" in env_id:
        assert env.unwrapped.config.step_m == pytest.approx(0.24)
    else:
        assert isinstance(perturbations[0], POINT.find(env.spec.kwargs["perturbed_by"]))


@pytest.mark.parametrize("given", [{"step_m": "0.1"}, {"step_rad": None}, {"step_m": -1}])
def test_a_faster_motion_of_no_length_is_refused(given) -> None:
    with pytest.raises(InputError, match=next(iter(given))):
        gymnasium.make("MSActiveSLAM-FreeCamera-FastMotion-v0", **given)


def test_an_id_passes_the_checker_and_takes_options() -> None:
    env = gymnasium.make(
        "MSActiveSLAM-FreeCamera-MotionBlur-v0", perturbation={"exposure_s": 0.01}, **OPTIONS
    )
    assert env.unwrapped.camera_feed.perturbations[0].exposure_s == 0.01
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of wrapped environments it says that they are wrapped
        check_env(env, skip_render_check=True)
    assert env.get_wrapper_attr("action_masks")().shape == (49,)


def test_vectors_of_environments() -> None:
    env = gymnasium.make_vec(
        "MSActiveSLAM-FreeCamera-RollingShutter-v0",
        num_envs=2,
        vectorization_mode="sync",
        **OPTIONS,
    )
    env.reset(seed=1)
    env.step(np.array([35, 6]))
    env = gymnasium.make_vec("MSActiveSLAM-FreeCamera-BlackFrames-v0", num_envs=2, **OPTIONS)
    observations, _ = env.reset(seed=1)
    assert observations.shape[0] == 2
    env.step(np.array([35, 6]))


def test_the_arm_gives_the_optics_its_path() -> None:
    options = {**OPTIONS, "scene": "table", "step_m": 0.06, "step_rad": 0.1}
    env = gymnasium.make("MSActiveSLAM-MotionBlur-v0", perturbation={"exposure_s": 0.03}, **options)
    env.reset(seed=2)
    mask = env.unwrapped.action_masks()
    action = int(np.flatnonzero(mask)[-1])
    env.step(action)
    inner = env.unwrapped
    assert len(inner.episode.timestamps) >= 2
    frame = inner.episode.last_frame
    plain = gymnasium.make("MSActiveSLAM-v0", **options)
    plain.reset(seed=2)
    plain.step(action)
    np.testing.assert_array_equal(
        plain.unwrapped.episode.trajectory_truth, inner.episode.trajectory_truth
    )
    np.testing.assert_array_equal(plain.unwrapped.episode.last_frame.depth, frame.depth)
    assert not np.array_equal(plain.unwrapped.episode.last_frame.color, frame.color)


def test_sequences_and_environments_share_the_classes() -> None:
    """A still camera in a sequence sees what a still camera in the environment sees."""
    env = perturbed("depth-dropout")
    frames, _ = play(env, actions=(0, 0))
    inner = env.unwrapped
    seed = inner.camera_feed.get_state()["noise_seed"]
    sequence = render_sequence(
        inner.scene,
        inner.episode.trajectory_truth,
        inner.intrinsics,
        inner.config.noise,
        seed,
        perturbations=[make_perturbation("depth-dropout")],
        timestamps=inner.episode.timestamps,
    )
    assert_same(frames, list(sequence.frames))
