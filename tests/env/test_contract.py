"""The environment's contract: spaces, infos, determinism, state, vector envs, bad input."""

import pickle
import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ms_slam_env
from ms_slam_env import scenes
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.env_config import EnvConfig, make_config
from ms_slam_env.env.registry import OBSERVATIONS
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import look_at
from ms_slam_env.robot import decompose

OPTIONS = {"scene": "living_room", "scene_seed": 0}
ARM = {"scene": "table", "scene_seed": 0, "arm": {"frames_per_action": 2}}
IDS = tuple(env_id for env_id in ms_slam_env.ENV_IDS if "Adaptive" not in env_id)
"""Those with actions that are one number; ``test_adaptive_env`` has the other."""
NUM_ACTIONS = {
    "MSActiveSLAM-v0": 49,
    "MSActiveSLAM-FreeCamera-v0": 49,
    "MSActiveSLAM-FixedTranslation-v0": 7,
    "MSActiveSLAM-Adaptive-v0": [49, 3],
}


def assert_same(a, b, where="value"):
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for index, (left, right) in enumerate(zip(a, b, strict=True)):
            assert_same(left, right, f"{where}[{index}]")
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, where)
    else:
        assert a == b, where


def random_actions(env, count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield int(rng.choice(np.flatnonzero(env.unwrapped.action_masks())))


@pytest.fixture(scope="module")
def env():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **OPTIONS)
    yield env
    env.close()


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        *(("MSActiveSLAM-FreeCamera-v0", {"observation": name}) for name in OBSERVATIONS),
        ("MSActiveSLAM-FixedTranslation-v0", {"observation": "held"}),
        ("MSActiveSLAM-v0", {"observation": "rgbd"}),
        ("MSActiveSLAM-v0", {"embodiment": "arm-kinematic", "scene": "wall"}),
        *(
            ("MSActiveSLAM-Adaptive-v0", {"embodiment": "free", "observation": name})
            for name in ("rgbd", "features")
        ),
    ],
)
def test_gymnasium_checker_finds_nothing(env_id, options, recwarn):
    env = gym.make(env_id, **{**OPTIONS, **options})
    assert np.array_equal(env.action_space.nvec if "Adaptive" in env_id else env.action_space.n,
                          NUM_ACTIONS[env_id])  # fmt: skip
    check_env(env.unwrapped, skip_render_check=True)
    assert not [str(one.message) for one in recwarn if "infinity" not in str(one.message)]


def test_every_documented_info_key_exists_and_no_other(env):
    documented = set(
        re.findall(r"``(\w+)``", ActiveSlamEnv.__doc__.split("## Info")[1].split("No")[0])
    )
    env.reset(seed=0)
    _, reward, _, _, info = env.step(0)
    assert documented == set(info)
    assert reward == pytest.approx(sum(info["reward_terms"].values()), abs=1e-12)
    assert info["T_world_camera"].shape == info["T_world_camera_estimate"].shape == (4, 4)
    assert info["divergence"].shape == (2,)
    assert info["action_mask"].shape == (49,)
    assert info["action_mask"].dtype == bool


def test_ate_is_the_running_rmse_of_the_pose_error(env):
    _, info = env.reset(seed=3)
    errors = [info["pose_error"]]
    for action in random_actions(env, 5):
        info = env.step(action)[4]
        difference = info["T_world_camera"][:3, 3] - info["T_world_camera_estimate"][:3, 3]
        assert info["pose_error"] == pytest.approx(np.linalg.norm(difference))
        errors.append(info["pose_error"])
        assert info["ate"] == pytest.approx(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize(
    ("env_id", "options"),
    [*((env_id, OPTIONS) for env_id in IDS[1:]), ("MSActiveSLAM-v0", ARM)],
)
def test_two_envs_with_one_seed_agree_to_the_bit(env_id, options):
    a, b = (gym.make(env_id, observation="rgbd", **options) for _ in range(2))
    assert_same(a.reset(seed=7), b.reset(seed=7))
    for action in random_actions(a, 6):
        assert_same(a.step(action), b.step(action))


def test_at_one_place_another_seed_is_another_noise():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", observation="rgbd", image_size="64x48", **OPTIONS)
    _, info = env.reset(seed=0)
    here = {"T_world_camera": info["T_world_camera"]}
    first, other, again = (env.reset(seed=seed, options=here)[0] for seed in (0, 1, 0))
    assert_same(again, first)
    assert (other["depth"] != first["depth"]).any()


def test_episodes_in_a_row_are_in_one_scene_until_a_seed_draws_another():
    options = {"scene": ("table", "wall"), "num_scene_seeds": 3, "episodes_per_scene": 2}
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **options)

    def place(seed=None):
        env.reset(seed=seed)
        return env.unwrapped.simulation.place

    places = [place(0), *(place() for _ in range(7))]
    assert places[::2] == places[1::2]
    assert len(set(places)) > 1
    assert [place(0), *(place() for _ in range(7))] == places
    assert [place(0), place(0)] == places[:2]
    assert place() == places[0]
    place(0)
    env = pickle.loads(pickle.dumps(env))
    assert [place(), place()] == places[1:3]
    state = env.unwrapped.save_state()
    env.unwrapped.load_state(state)
    after = [place() for _ in range(4)]
    assert after[::2] == after[1::2]  # the first of them draws


def test_a_reset_may_say_where_it_is_and_all_else_is_as_its_seed_has_it():
    options = {"scene": ("table", "wall"), "num_scene_seeds": 3, "episodes_per_scene": 3}
    env, other = (gym.make("MSActiveSLAM-FreeCamera-v0", **options) for _ in range(2))
    drawn = env.reset(seed=4)
    where = {name: drawn[1][name] for name in ("scene", "scene_seed")}
    assert_same(other.reset(seed=4, options=where), drawn)
    assert_same(other.step(5), env.step(5))
    # Elsewhere, in a scene that is none of its own; the generator is where it would be.
    _, info = other.reset(seed=4, options={"scene": "corridor", "scene_seed": 7000})
    assert (info["scene"], info["scene_seed"]) == ("corridor", 7000)
    state = pickle.loads(pickle.dumps(other.unwrapped.save_state()))
    outcome = other.step(5)
    env.unwrapped.load_state(state)
    assert_same(env.step(5), outcome)
    assert_same(pickle.loads(pickle.dumps(other)).step(5), other.step(5))
    # The next episode is drawn again, and is in one of its own scenes.
    assert other.reset()[1]["scene"] in options["scene"]
    _, info = other.reset(seed=4, options={"scene_seed": 5})
    assert (info["scene"], info["scene_seed"]) == (where["scene"], 5)
    _, info = other.reset(seed=4, options={"scene": "wall"})
    assert (info["scene"], info["scene_seed"]) == ("wall", where["scene_seed"])


def test_a_vector_of_environments_is_told_where_it_is():
    small = {"image_size": "64x48", "scene": "table"}
    envs = gym.make_vec("MSActiveSLAM-FreeCamera-v0", num_envs=2, **small)
    _, infos = envs.reset(seed=0, options={"scene": "wall", "scene_seed": 3})
    assert [*infos["scene"]] == ["wall", "wall"]
    assert [*infos["scene_seed"]] == [3, 3]
    envs.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"scene": "attic"}, r"reset option scene 'attic'; valid choices: living_room, corridor"),
        ({"scene": "os:system"}, "reset option scene 'os:system'"),
        ({"scene": "scan.glb"}, "reset option scene 'scan.glb'"),
        ({"scene": np.zeros(3)}, "reset option scene"),
        ({"scene": ["table"]}, "reset option scene"),
        ({"scene_seed": -1}, "reset option scene_seed = -1 must be an integer >= 0"),
        ({"scene_seed": True}, "scene_seed = True"),
        ({"scene_seed": 1.5}, "scene_seed = 1.5"),
        ({"where": 1}, r"\['where'\]; valid choices: T_world_camera, scene, scene_seed"),
    ],
)
def test_a_reset_that_says_something_else_is_refused(env, options, said):
    with pytest.raises(InputError, match=said):
        env.reset(seed=0, options=options)


def test_seeds_of_ones_own_are_drawn_from():
    config = EnvConfig(split="7000-7002,8000")
    rng = np.random.default_rng(0)
    assert {config.draw_scene(rng)[1] for _ in range(60)} == {7000, 7001, 7002, 8000}
    assert {replace(config, num_scene_seeds=2).draw_scene(rng)[1] for _ in range(30)} == {
        *(7000, 7001)
    }
    assert len({EnvConfig().draw_scene(rng)[1] for _ in range(1000)}) == 100
    for split in ("tests", "7000-", 7000, ["train"]):
        with pytest.raises(InputError, match=r"split of seeds .*; valid choices: train, valid"):
            EnvConfig(split=split)


def table(seed):  # the name of a scene that there is
    """A scene as a function: a wall."""
    return scenes.make("wall", seed=seed)


def test_a_scene_that_is_a_function_is_gone_back_to():
    options = {"scene": (table, "corridor"), "num_scene_seeds": 1}
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **options)
    for seed in range(9):
        _, info = env.reset(seed=seed)
        if info["scene"] == "table":
            break
    state = env.unwrapped.save_state()
    outcome = env.step(5)
    world = env.unwrapped.simulation.world
    env.unwrapped.load_state(state)
    assert env.unwrapped.simulation.world is world
    assert_same(env.step(5), outcome)
    other = gym.make("MSActiveSLAM-FreeCamera-v0", **options)
    other.unwrapped.load_state(state)
    assert other.unwrapped.simulation.place == (table, state["episode"].scene_seed)
    assert_same(other.step(5), outcome)


def test_functions_of_one_name_are_two_scenes():
    one, other = (
        lambda seed, name=name: scenes.make(name, seed=seed) for name in ("wall", "table")
    )
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene=(one, other), num_scene_seeds=1)
    env.reset(seed=0)
    place = env.unwrapped.simulation.place
    env.unwrapped.foresee([1, 2])
    assert env.unwrapped.simulation.place == place


def test_a_prediction_is_by_the_options_of_who_goes_on():
    options = {**OPTIONS, "image_size": "80x60"}
    one, other = (
        gym.make("MSActiveSLAM-FreeCamera-v0", **options, lookahead={"reference": name}).unwrapped
        for name in ("predicted", "live")
    )
    one.reset(seed=3)
    one.step(5)
    before = one.lookahead()
    other.load_state(one.save_state())
    assert (other.lookahead() != before).any()
    one.load_state(other.save_state())
    np.testing.assert_array_equal(one.lookahead(), before)


def test_pickling_before_reset_keeps_the_options():
    env = ActiveSlamEnv(step_m=0.03, **OPTIONS)
    assert pickle.loads(pickle.dumps(env)).config == env.config


@pytest.mark.parametrize(
    ("mode", "env_id", "options"),
    [
        *((mode, "MSActiveSLAM-FreeCamera-v0", OPTIONS) for mode in (None, "sync", "async")),
        (None, "MSActiveSLAM-v0", ARM),
        ("sync", "MSActiveSLAM-FreeCamera-v0", {**OPTIONS, "observation": "candidates"}),
    ],
)
def test_vector_modes_agree_with_the_single_env(mode, env_id, options):
    env = gym.make(env_id, **options)
    vector = gym.make_vec(env_id, num_envs=2, vectorization_mode=mode, **options)
    try:
        observations, _ = vector.reset(seed=[11, 12])
        stepped, rewards, *_ = vector.step(np.array([5, 36]))
    finally:
        vector.close()
    for index, (seed, action) in enumerate([(11, 5), (12, 36)]):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observations[index], observation)
        observation, reward, *_ = env.step(action)
        np.testing.assert_array_equal(stepped[index], observation)
        assert rewards[index] == reward


def test_blocked_motion_is_masked_and_does_nothing(env):
    env.reset(seed=0)
    scene = env.unwrapped.scene
    pose = scene.sample_start(np.random.default_rng(0))
    while scene.segment_is_free(pose[:3, 3], pose[:3, 3] - 0.06 * pose[:3, 2], 0.1):
        pose[:3, 3] -= 0.02 * pose[:3, 2]
    _, info = env.reset(seed=0, options={"T_world_camera": pose})
    backward = 7 * 6
    assert not info["action_mask"][backward]
    assert info["action_mask"][:7].all()
    _, _, _, _, info = env.step(backward)
    np.testing.assert_array_equal(info["T_world_camera"], pose)
    assert info["reward_terms"]["blocked"] < 0


def test_blind_start_is_refused(env):
    env.reset(seed=0)
    scene = env.unwrapped.scene
    pose = scene.sample_start(np.random.default_rng(0))
    while scene.segment_is_free(pose[:3, 3], pose[:3, 3] + 0.06 * pose[:3, 2], 0.1):
        pose[:3, 3] += 0.02 * pose[:3, 2]
    with pytest.raises(InputError, match="too few depth readings"):
        env.reset(seed=0, options={"T_world_camera": pose})
    with pytest.raises(InputError, match="reset"):
        env.unwrapped.step(0)


def test_motion_is_the_papers_decomposition(env):
    _, info = env.reset(seed=4)
    action = next(a for a in (8, 15, 22, 29) if info["action_mask"][a])
    before = info["T_world_camera"]
    config = env.unwrapped.config
    info = env.step(action)[4]
    expected = before @ decompose(config.step_m, config.step_rad)[action]
    np.testing.assert_allclose(info["T_world_camera"], expected, atol=1e-12)


def test_fixed_translation_moves_along_one_line():
    env = gym.make("MSActiveSLAM-FixedTranslation-v0", **OPTIONS)
    _, info = env.reset(seed=0)
    positions = [info["T_world_camera"][:3, 3]]
    for action in random_actions(env, 12):
        positions.append(env.step(action)[4]["T_world_camera"][:3, 3])
    steps = np.diff(positions, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), env.unwrapped.config.step_m)
    assert np.linalg.matrix_rank(steps, tol=1e-9) == 1


@pytest.mark.parametrize("reference", ["live", "predicted"])
def test_lookahead_predicts_every_candidate(reference):
    env = gym.make("MSActiveSLAM-v0", lookahead={"reference": reference}, **OPTIONS).unwrapped
    env.reset(seed=0)
    for action in random_actions(env, 3):
        env.step(action)
    predicted = env.lookahead()
    assert predicted.shape == (49, 2)
    assert np.isfinite(predicted).all()
    assert (predicted >= 0).all()
    views = env.predict_candidates()
    assert views.depth.shape[0] == 49
    if reference == "predicted":  # the first candidate is the reference itself
        np.testing.assert_allclose(predicted[0], 0, atol=1e-9)
        assert predicted[1:].max() > 0


def test_black_frames_in_a_row_end_the_episode_as_lost(env, monkeypatch):
    env.reset(seed=0)
    frame = env.unwrapped.episode.last_frame
    black = type(frame)(np.zeros_like(frame.color), np.zeros_like(frame.depth), 0.0)
    patience = env.unwrapped.config.lost_patience
    with monkeypatch.context() as dark:
        dark.setattr(type(env.unwrapped.sensor), "capture", lambda *_, **__: black)
        assert not any(env.step(0)[2] for _ in range(patience - 1))
    assert env.step(0)[4]["tracking_ok"]  # and the count begins anew
    monkeypatch.setattr(type(env.unwrapped.sensor), "capture", lambda *_, **__: black)
    for step in range(1, patience + 1):
        _, _, terminated, _, info = env.step(1)
        assert not info["tracking_ok"]
        assert info["reward_terms"]["lost"] < 0
        assert terminated == (step == patience)
    assert info["reward_terms"]["lost_for_good"] < 0


def test_render_explains_the_moment():
    env = gym.make("MSActiveSLAM-v0", render_mode="rgb_array", **OPTIONS)
    env.reset(seed=0)
    before = env.render()
    env.step(5)
    after = env.render()
    assert before.shape == after.shape == (480, 1120, 3)
    assert before.dtype == np.uint8
    for columns in (slice(0, 320), slice(320, 800), slice(800, 1120)):
        assert (before[:, columns] != after[:, columns]).any()


@pytest.mark.parametrize(
    ("env_id", "said", "wrong"),
    [
        (
            "MSActiveSLAM-FreeCamera-v0",
            r"not an integer in \[0, 48\]",
            [
                *(49, -1, 3.0, "left", None, True, {}, 10**400, [[1], [2, 3]]),
                *(np.array([1, 2]), np.array([[1], [2]])),
            ],
        ),
        (
            "MSActiveSLAM-FixedTranslation-v0",
            r"not an integer in \[0, 6\]",
            [7, -1, "left", 2.5, np.nan],
        ),
        (
            "MSActiveSLAM-Adaptive-v0",
            r"is not two integers in \[0, 48\] x \[0, 2\]",
            [3, [0, 3], [49, 0], [0.5, 0], [0, 1, 2], None],
        ),
    ],
)
def test_bad_actions_name_their_range(env_id, said, wrong):
    options = {"embodiment": "free"} if "Adaptive" in env_id else {}
    env = gym.make(env_id, scene="carpet", scene_seed=0, **options).unwrapped
    env.reset(seed=0)
    for action in wrong:
        with pytest.raises(InputError, match=said):
            env.step(action)


def test_step_before_reset_of_a_made_env_says_so():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", **OPTIONS)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(0)


def test_use_before_reset_says_so():
    env = ActiveSlamEnv(**OPTIONS)
    for use in (lambda: env.step(0), env.lookahead, env.save_state, env.action_masks):
        with pytest.raises(InputError, match="reset"):
            use()


def test_options_of_slam_stand_behind_its_name_and_in_slam_config():
    still = {"motion_mask": "none", "submaps": "off"}
    assert EnvConfig().slam_config == {"refuse_open": True, **still}
    both = make_config({"slam": "surfel,check_slips=true", "slam_config": {"check_slips": False}})
    assert (both.slam, both.slam_config) == ("surfel", {"check_slips": False})
    assert replace(both, step_m=0.1).slam_config == {"check_slips": False}
    assert make_config({"slam": "sparse"}).slam_config == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "no-such-scene"}, "valid choices: living_room"),
        ({"scene": None}, "scene = None must be a name or several"),
        ({"scene": ()}, "must be a name or several"),
        ({"slam": "orb"}, "valid choices: .*surfel"),
        ({"slam": "surfel,check"}, "backend 'surfel,check': 'check' is not option=value"),
        ({"slam": "surfel,slips=1"}, "unknown option of SurfelConfig 'slam_config.slips'"),
        ({"observation": "pixel"}, "valid choices: rgbd, images, pixels, features"),
        (
            {"steps": 3},
            "'steps'; valid choices: embodiment, render_mode, task, max_episode_steps, scene",
        ),
        ({"targets": {"M_X": 1}}, "unknown option of TargetConfig 'targets.M_X'"),
        ({"reward": {"lost": -1}}, r"RewardConfig.lost = -1 is outside \[0"),
        ({"slam_config": {"depth": 1}}, "depth_cutoff_m"),
        ({"slam_config": 3}, "slam_config = 3 must be a mapping"),
        ({"reward": 3}, "reward = 3 must be a function of an Outcome, module:function, default"),
        ({"lookahead": {"view": 1}}, "'lookahead.view'; valid choices: reference, scale"),
        ({"scene_seed": -1}, "scene seed -1 must be an integer >= 0"),
        ({"slam_config": {"depth_cutoff_m": 13}}, r"outside \[0, 12\]"),
        ({"image_size": "1x1"}, "valid choices: 80x60"),
        ({"image_size": 160}, "unknown image size '160'"),
        ({"image_size": "native"}, "no size of their own"),
        ({"field_of_view_deg": 5}, r"field_of_view_deg = 5 is outside \[10, 150\]"),
        ({"noise": "lots"}, "valid choices: kinect, range, none"),
        ({"noise": 3}, "unknown noise model '3'"),
        ({"noise": {"name": "kinect", "axal": 1}}, "option of noise 'axal'; valid choices: name,"),
        ({"noise": {"strength": -1}}, r"noise strength = -1 is outside \[0, 100\]"),
        ({"noise": {"axial": 1000}}, r"axial = 1000 is outside \[0, 100\]"),
        ({"split": "exam"}, "valid choices: train, validation, test"),
        ({"step_m": float("nan")}, "step_m = nan is outside"),
        ({"render_mode": "ansi"}, "valid choices: None, rgb_array"),
        ({"embodiment": {}}, "unknown embodiment '{}'; valid choices: arm"),
        ({"slam_config": {7: 1}}, "slam_config = {7: 1} must be a mapping of options"),
        ({"embodiment": "boat"}, "unknown embodiment 'boat'; valid choices: arm, arm-kinematic"),
        ({"slam": ["surfel"]}, "valid choices: .*surfel"),
        ({"slam_config": {"device": "tpu"}}, "unknown device 'tpu'; valid choices: cpu"),
        ({"scene": "missing.glb"}, "mesh file 'missing.glb' does not exist"),
        ({"scene": "foo.txt"}, ".glb, .gltf, .obj, .ply, .stl, .off"),
        ({"scene": "."}, ".glb, .gltf, .obj, .ply, .stl, .off"),
    ],
)
def test_bad_option_gives_one_clear_line(options, message):
    with pytest.raises(InputError, match=message) as caught:
        ActiveSlamEnv(**options).reset(seed=0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("options", [5, "pose", ["T_world_camera"], True])
def test_reset_options_of_another_type_are_refused(env, options):
    with pytest.raises(InputError, match="must be a mapping or None"):
        env.unwrapped.reset(options=options)


@pytest.mark.parametrize("seed", [-1, 1.5, "one", True, [1]])
def test_a_bad_seed_is_refused(env, seed):
    with pytest.raises(InputError, match="must be an integer >= 0 or None"):
        env.unwrapped.reset(seed=seed)


def test_bad_reset_options(env):
    with pytest.raises(InputError, match="T_world_camera"):
        env.reset(options={"pose": 1})
    with pytest.raises(InputError, match="finite"):
        env.reset(options={"T_world_camera": np.full((4, 4), np.nan)})
    inside_wall = look_at([100.0, 0, 0], [0.0, 0, 0])
    with pytest.raises(InputError, match="free"):
        env.reset(options={"T_world_camera": inside_wall})


def test_a_refused_reset_leaves_no_mixture_of_episodes():
    env = ActiveSlamEnv(**OPTIONS)
    env.reset(seed=0)
    with pytest.raises(InputError, match="finite"):
        env.reset(options={"T_world_camera": np.full((4, 4), np.nan)})
    with pytest.raises(InputError, match="must be reset"):
        env.step(0)
