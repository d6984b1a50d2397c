"""Continuous actions: the 49 motions to the bit, stops on the way, states, vectors, refusals."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from small_env import FREE, small_env

import ms_slam_env
from ms_slam_env.env.continuous import point_of
from ms_slam_env.env.planners import make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, make_pose, so3_exp
from ms_slam_env.robot.action_primitives import decompose, describe, shares_of
from ms_slam_env.robot.free_camera import CAMERA_RADIUS_M

ARM = "MSActiveSLAM-v0"
FORWARD = np.array([0, 0, 1, 0, 0, 0], np.float32)


def continuous(env_id=FREE, **options):
    return small_env(env_id, actions="continuous", **options)


def assert_same_step(one, other):
    """But for what stands in the place of the mask."""
    for part in one[0]:
        np.testing.assert_array_equal(one[0][part], other[0][part], part)
    assert one[1:-1] == other[1:-1]
    for key in one[-1].keys() - {"action_mask"}:
        np.testing.assert_equal(one[-1][key], other[-1][key], key)


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (FREE, {}),
        (FREE, {"frames_per_action": 3, "step_m": 0.05}),
        (ARM, {}),
        (ARM, {"embodiment": "arm-kinematic"}),
        (ARM, {"embodiment": "arm-kinematic", "step_m": 0.15, "step_rad": 0.1}),
    ],
)
def test_the_49_motions_are_points_of_the_box_to_the_bit(env_id, options):
    discrete = small_env(env_id, observation="rgbd", **options)
    env = continuous(env_id, observation="rgbd", **options)
    assert_same_step(discrete.reset(seed=2), env.reset(seed=2))
    made = 0
    for action in np.random.default_rng(0).permutation(49):
        if discrete.unwrapped.action_masks()[action]:
            now = env.step(point_of(action).astype(np.float32))
            assert_same_step(discrete.step(action), now)
            assert now[-1]["travelled"] == 1
            made += 1
    assert made >= 15


def test_an_action_is_a_straight_way_and_a_turn_in_the_cameras_frame():
    env = continuous(step_m=0.1, step_rad=0.2)
    _, info = env.reset(seed=0)
    action = np.array([0.3, -0.2, 0.5, 0.4, -1, 0.25], np.float32)
    before, (_, _, _, _, info) = info["T_world_camera"], env.step(action)
    twist = action.astype(float) * [0.1, 0.1, 0.1, 0.2, 0.2, 0.2]
    wanted = before @ make_pose(so3_exp(twist[3:]), twist[:3])
    np.testing.assert_allclose(info["T_world_camera"], wanted, atol=1e-12)
    assert info["travelled"] == 1


def into_something(env, action, most=60):
    """Step until the way is not free; return ``info`` before and after, and the reward terms."""
    _, info = env.reset(seed=0)
    for _ in range(most):
        before, (_, _, _, _, info) = info, env.step(action)
        if info["travelled"] < 1:
            return before, info
    raise AssertionError("nothing was in the way")


def test_a_free_camera_stops_where_the_slow_way_says():
    env = continuous(step_m=0.2)
    action = np.array([0.25, 0, 1, 0, 0.5, 0], np.float32)
    before, after = into_something(env, action)
    start, scene = before["T_world_camera"], env.unwrapped.scene
    way = 0.2 * start[:3, :3] @ action[:3].astype(float)
    free = 0
    for k in range(1, 33):
        if scene.segment_is_free(start[:3, 3], start[:3, 3] + k / 32 * way, CAMERA_RADIUS_M):
            free = k
    assert after["travelled"] == free / 32 < 1
    part = free / 32 * action.astype(float)
    turn = env.unwrapped.config.step_rad * part[3:]
    wanted = start @ make_pose(so3_exp(turn), 0.2 * part[:3])
    np.testing.assert_allclose(after["T_world_camera"], wanted, atol=1e-12)
    assert scene.clearance(after["T_world_camera"][None, :3, 3])[0] >= CAMERA_RADIUS_M - 1e-6
    assert after["reward_terms"]["blocked"] == -0.1
    *_, info = env.step(np.array([0, 0, 0, 0, 1, 0], np.float32))
    assert info["travelled"] == 1  # a turn is always free
    assert info["reward_terms"]["blocked"] == 0


@pytest.mark.parametrize("embodiment", ["arm-kinematic", "arm"])
def test_an_arm_makes_the_longest_part_that_it_can(embodiment):
    env = continuous(ARM, embodiment=embodiment, arm={"noise": "none", "frames_per_action": 2})
    before, after = into_something(env, FORWARD)
    share = after["travelled"]
    moved = invert(before["T_world_camera"]) @ after["T_world_camera"]
    loose = 0.003 if embodiment == "arm" else 2e-4  # metres; servos give way
    np.testing.assert_allclose(moved[:3, 3], [0, 0, share * 0.12], atol=loose)
    arm = env.unwrapped.embodiment
    assert not arm.action_masks()[35]  # forward as a whole is still impossible
    left = continuous(ARM, embodiment=embodiment, arm={"noise": "none", "frames_per_action": 2})
    _, info = left.reset(seed=0)
    while info["travelled"] == 1:
        state = left.unwrapped.save_state()
        *_, info = left.step(FORWARD)
    left.unwrapped.load_state(state)
    arm, parts = left.unwrapped.embodiment, np.arange(1, 17) / 16
    q, T_base_camera = arm.planning_state()
    targets = T_base_camera @ np.stack([make_pose(np.eye(3), [0, 0, p * 0.12]) for p in parts])
    single = [bool(arm.feasibility.probe(q, target[None]).ok[0]) for target in targets]
    assert share == max((p for p, ok in zip(parts, single, strict=True) if ok), default=0)


def test_where_a_protective_stop_ends_a_motion(monkeypatch):
    env = continuous(ARM, arm={"noise": "none", "frames_per_action": 2})
    _, info = env.reset(seed=0)
    arm = env.unwrapped.embodiment
    monkeypatch.setattr(arm, "_first_touch", lambda plan, q: (len(plan.q) - 1) // 3)
    before, (*_, after) = info["T_world_camera"], env.step(FORWARD)
    moved = (invert(before) @ after["T_world_camera"])[2, 3]
    assert 0.1 < after["travelled"] < 0.5
    assert moved == pytest.approx(after["travelled"] * 0.12, abs=0.003)
    assert after["reward_terms"]["blocked"] == -0.1


def test_a_way_that_the_map_did_not_know_to_be_blocked_is_known_then():
    env = continuous(mask="map", pose="ground_truth")
    into_something(env, FORWARD)
    assert not env.unwrapped.simulation.action_masks()[35:42].any()


@pytest.mark.parametrize(
    "action",
    [
        [0, 0, np.nan, 0, 0, 0],
        [0, 0, 0, np.inf, 0, 0],
        [0, 0, 0, 0, 0, 1.01],
        [0.0] * 5,
        np.zeros((2, 6)),
        np.zeros((6, 6)),
        35,
        "forward",
        None,
        [0, 0, 0, 0, 0, [1]],
        [True] * 6,
        [1j] * 6,
    ],
)
def test_what_is_no_action_is_refused_in_one_line(action):
    env = continuous()
    env.reset(seed=0)
    before = env.unwrapped.episode.copy()
    with pytest.raises(InputError, match=r"is not six finite numbers in \[-1, 1\]$") as caught:
        env.unwrapped.step(action)
    assert "\n" not in str(caught.value)
    assert len(env.unwrapped.episode.frames) == len(before.frames)


def test_there_is_no_mask_and_that_is_said():
    env = continuous()
    _, info = env.reset(seed=0)
    assert "action_mask" not in info
    with pytest.raises(InputError, match=r"continuous actions have no mask: .* stops short"):
        env.unwrapped.action_masks()
    with pytest.raises(InputError, match=r"'nbv' chooses among discrete motions; .* continuous"):
        make_planner("nbv", env.unwrapped)
    planner = make_planner("random", env.unwrapped)
    drawn = np.stack([planner.act(None, info) for _ in range(200)])
    assert env.action_space.contains(drawn[0])
    assert (np.abs(drawn.mean(axis=0)) < 0.2).all()
    assert (drawn.std(axis=0) > 0.5).all()


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("MSActiveSLAM-FixedTranslation-v0", "valid choices: free, arm, arm-kinematic"),
        ("MSActiveSLAM-Adaptive-v0", "the agent also chooses the SLAM configuration"),
    ],
)
def test_environments_with_actions_of_their_own_refuse(env_id, message):
    with pytest.raises(InputError, match=message):
        continuous(env_id)


def test_a_batch_refuses():
    with pytest.raises(InputError, match="in a batch actions must be 'discrete', not 'continuous'"):
        gym.make_vec(f"batched/{FREE}", num_envs=1, actions="continuous")


def test_the_ids_are_those_of_the_discrete_ones():
    assert ms_slam_env.CONTINUOUS_IDS[0] == "MSActiveSLAM-Continuous-v0"
    for env_id in ms_slam_env.CONTINUOUS_IDS:
        own, discrete = gym.spec(env_id), gym.spec(env_id.replace("-Continuous", ""))
        assert own.max_episode_steps == discrete.max_episode_steps
        assert own.kwargs == {**discrete.kwargs, "actions": "continuous"}
        env = gym.make(env_id)
        assert env.action_space == gym.spaces.Box(-1, 1, (6,), np.float32)


def test_gymnasiums_checker_finds_nothing(recwarn):
    check_env(continuous().unwrapped, skip_render_check=True)
    assert not [str(one.message) for one in recwarn if "infinity" not in str(one.message)]


def test_a_perturbed_camera_takes_them():
    env, still = (
        continuous(
            "MSActiveSLAM-FreeCamera-MotionBlur-v0", observation="rgbd", noise="none", **more
        )
        for more in ({}, {"perturbation": {"exposure_s": 1e-6}})
    )
    for one in (env, still):
        one.reset(seed=0)
    action = np.array([0, 0, 0, 0, 0.9, 0], np.float32)
    blurred, sharp = (one.step(action)[0]["color"].astype(int) for one in (env, still))
    assert np.abs(np.diff(blurred, axis=1)).mean() < 0.9 * np.abs(np.diff(sharp, axis=1)).mean()


def drawn(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


@pytest.mark.parametrize("env_id", [FREE, ARM])
def test_an_episode_goes_on_from_a_saved_state_to_the_bit(env_id):
    env = continuous(env_id, observation="rgbd")
    env.reset(seed=0)
    *first, last = drawn(env, 5)
    for action in first:
        env.step(action)
    state = env.unwrapped.save_state()
    foreseen = env.unwrapped.foresee([last, np.zeros(6)])
    copied = pickle.loads(pickle.dumps(env))
    then = env.step(last)
    assert then[1] == foreseen[0]
    assert_same_step(then, copied.step(last))
    other = continuous(env_id, observation="rgbd")
    other.unwrapped.load_state(state)
    np.testing.assert_array_equal(other.unwrapped.episode.action, first[-1])
    assert_same_step(then, other.step(last))
    discrete = small_env(env_id, observation="rgbd")  # a state is one of the same world
    discrete.unwrapped.load_state(state)
    discrete.step(0)


@pytest.mark.parametrize("action", [np.full(6, np.nan), np.full(6, 2.0), np.zeros(5), 49, "up"])
def test_a_state_with_no_such_action_is_refused(action):
    env = continuous()
    env.reset(seed=0)
    state = env.unwrapped.save_state()
    state["episode"].action = action
    with pytest.raises(InputError, match=r"episode\.action"):
        env.unwrapped.load_state(state)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_in_a_vector_each_is_as_alone(mode):
    options = {"scene": "table", "scene_seed": 0, "image_size": "64x48"}
    env_id = "MSActiveSLAM-FreeCamera-Continuous-v0"
    envs = gym.make_vec(env_id, num_envs=2, vectorization_mode=mode, **options)
    alone = [gym.make(env_id, **options) for _ in range(2)]
    together = envs.reset(seed=[3, 4])[0]
    for env, seed, seen in zip(alone, (3, 4), together, strict=True):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], seen)
    for action in drawn(alone[0], 3):
        seen, rewards, *_, infos = envs.step(np.stack([action, -action]))
        for k, env in enumerate(alone):
            now = env.step((action, -action)[k])
            np.testing.assert_array_equal(now[0], seen[k])
            assert (now[1], now[-1]["travelled"]) == (rewards[k], infos["travelled"][k])
    envs.close()


def test_the_state_vector_holds_the_shares_of_the_last_action():
    for action in range(49):
        translation, rotation = divmod(action, 7)
        hot = np.concatenate([np.eye(7)[translation], np.eye(7)[rotation]])
        np.testing.assert_array_equal(shares_of(point_of(action)), hot)
        one = make_pose(so3_exp(0.2 * point_of(action)[3:]), 0.1 * point_of(action)[:3])
        np.testing.assert_array_equal(one, decompose(0.1, 0.2)[action])
    env = continuous(observation="features")
    env.reset(seed=0)
    seen, *_ = env.step(np.array([-0.5, 0.25, 0, 0, 0, -0.75], np.float32))
    named = dict(zip(env.unwrapped.state_names, seen[:28], strict=True))
    hot = {k: v for k, v in named.items() if v and k.startswith(("translation_", "rotation_"))}
    assert hot == {
        **{"translation_none": 0.5, "translation_left": 0.5, "translation_down": 0.25},
        **{"rotation_none": 0.25, "rotation_roll_left": 0.75},
    }
    assert describe(env.unwrapped.episode.action) == "0.25 down, 0.50 left, 0.75 roll left"


def test_soft_actor_critic_learns():
    sb3 = pytest.importorskip("stable_baselines3")
    torch = pytest.importorskip("torch")
    env = continuous()
    model = sb3.SAC("MlpPolicy", env, learning_starts=16, batch_size=16, device="cpu", seed=0)
    before = [weight.detach().clone() for weight in model.actor.parameters()]
    model.learn(64)
    assert model._n_updates == 64 - 16
    after = list(model.actor.parameters())
    assert all(torch.isfinite(weight).all() for weight in after)
    assert all((a != b).any() for a, b in zip(before, after, strict=True))
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)
