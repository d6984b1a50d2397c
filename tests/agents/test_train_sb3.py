"""The training script end to end on a small fake environment that can be learnt."""

import csv
import json
import os
import signal
from types import SimpleNamespace
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from ms_slam_agents import artefact, evaluation, train_sb3
from ms_slam_agents.policy_planner import TrainedFeaturesPolicy, TrainedPolicy
from scipy.stats import sem
from stable_baselines3.common.vec_env import DummyVecEnv

from ms_slam_env.env.config import TargetConfig
from ms_slam_env.errors import InputError

NUM_ACTIONS = 7
ENV_ID = "LearnableFake-v0"


class LearnableFake(gym.Env):
    """The observation names the right action, which is never blocked; half of the others are."""

    log: ClassVar[list] = []

    def __init__(self, scene, split, num_scene_seeds, observation):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (NUM_ACTIONS,), np.float32)
        self.action_space = gym.spaces.Discrete(NUM_ACTIONS)
        self.config = SimpleNamespace(targets=TargetConfig(rho_I=0, rho_D=0))
        self.split = split

    def action_masks(self):
        return self.mask.copy()

    def lookahead(self):
        return 1.0 - np.repeat(np.eye(NUM_ACTIONS)[self.right][:, None], 2, axis=1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.score = 0.0
        return self._next(), self._info(0.0)

    def step(self, action):
        assert self.action_space.contains(action)
        self.log.append((self.split, bool(self.mask[action])))
        reward = float(action == self.right)
        self.score += reward
        return self._next(), reward, False, False, self._info(reward)

    def _next(self):
        self.right = int(self.np_random.integers(NUM_ACTIONS))
        self.mask = self.np_random.random(NUM_ACTIONS) < 0.5
        self.mask[self.right] = True
        return (10 * np.eye(NUM_ACTIONS)[self.right] + 3).astype(np.float32)

    def _info(self, reward):
        return {
            "tracking_ok": True,
            "mapped_area": self.score,
            "ate": 0.0,
            "reward_terms": {"right": reward},
        }


gym.register(ENV_ID, LearnableFake)


def arguments(out, *extra, steps=64, algorithm="maskable_ppo"):
    options = {
        "out": out,
        "env-id": ENV_ID,
        "algorithm": algorithm,
        "observation": "features",
        "total-timesteps": steps,
        "num-envs": 1,
        "episode-steps": 10,
        "eval-episodes": 3,
        "eval-every": 32,
        "n-steps": 32,
        "batch-size": 16,
        "n-epochs": 2,
        "hidden": 16,
    }
    return [word for name, value in options.items() for word in (f"--{name}", str(value))] + [
        *extra
    ]


def read_curve(out):
    return json.loads((out / "learning_curve.json").read_text())


@pytest.fixture(scope="module", params=["maskable_ppo", "ppo"])
def run(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param)
    LearnableFake.log.clear()
    assert train_sb3.main(arguments(out, algorithm=request.param)) == 0
    log = [permitted for split, permitted in LearnableFake.log if split == "train"]
    return SimpleNamespace(out=out, algorithm=request.param, train_log=log)


def fake_env(num_actions=NUM_ACTIONS, seed=0):
    rng = np.random.default_rng(seed)
    mask = rng.random(num_actions) < 0.5
    mask[0] = True
    return SimpleNamespace(
        action_space=gym.spaces.Discrete(num_actions), action_masks=lambda: mask.copy(), mask=mask
    )


def test_trains_for_the_steps_asked(run):
    metadata = artefact.load_metadata(run.out / "latest.zip")
    assert metadata.timesteps == 64 == len(run.train_log)
    assert (metadata.algorithm, metadata.observation) == (run.algorithm, "features")
    assert list((run.out / "tensorboard").rglob("events*"))
    assert not list(run.out.glob("*.partial*"))


def test_only_the_masked_variant_never_tries_a_blocked_action(run):
    assert all(run.train_log) == (run.algorithm == "maskable_ppo")


def test_learning_curve_is_well_formed(run):
    curve = read_curve(run.out)
    assert [point["timesteps"] for point in curve["points"]] == [0, 32, 64]
    with open(run.out / "learning_curve.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [{k: float(v) for k, v in row.items()} for row in rows] == curve["points"]
    assert (run.out / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    references = curve["references"]
    assert references["greedy"]["return"] == 10  # the fake's lookahead gives the answer away
    assert 0 < references["random walk"]["return"] < 10
    for point in curve["points"]:
        gain = point["return"] - references["random walk"]["return"]
        assert point["gain"] == pytest.approx(gain)
    assert all(point["steps"] == 10 and point["lost"] == 0 for point in curve["points"])


def test_paired_gain_against_scipy():
    returns, reference = np.random.default_rng(0).normal(size=(2, 9))
    gain = evaluation.paired_gain(list(returns), list(reference))
    assert gain["gain"] == pytest.approx(np.mean(returns - reference))
    assert gain["gain_sem"] == pytest.approx(sem(returns - reference))


@pytest.mark.parametrize("num_envs", [1, 2, 3])
def test_returns_come_in_the_order_of_the_seeds(num_envs):
    """However the episodes are dealt out: standing still, against playing one by one."""
    args = train_sb3.Args(env_id=ENV_ID, episode_steps=10, num_envs=1)
    seeds = [5, 6, 7, 8, 9]
    shares = [seeds[rank::num_envs] for rank in range(num_envs)]
    makers = [lambda share=share: train_sb3.make_env(args, "validation", share) for share in shares]

    def stay(_, masks):
        return np.zeros(len(masks), dtype=np.int64)

    result = evaluation.evaluate(DummyVecEnv(makers), len(seeds), stay)
    expected = []
    for seed in seeds:
        env = LearnableFake(None, None, None, None)
        env.reset(seed=seed)
        expected.append(sum(env.step(0)[1] for _ in range(10)))
    assert result["returns"] == expected


def test_same_seed_same_training(run, tmp_path):
    assert train_sb3.main(arguments(tmp_path, algorithm=run.algorithm)) == 0
    first, second = read_curve(run.out), read_curve(tmp_path)
    for point in first["points"] + second["points"]:
        del point["minutes"]
    assert first == second


def test_the_planner_acts_as_the_trained_network_does(run):
    """Against Stable-Baselines3's own prediction on normalised observations."""
    path = run.out / "latest.zip"
    model = artefact.ALGORITHMS[run.algorithm].load(path)
    moments = artefact.load_metadata(path).observation_moments
    rng = np.random.default_rng(0)
    for seed in range(20):
        env = fake_env(seed=seed)
        planner = TrainedFeaturesPolicy(env, path=str(path), deterministic="true")
        observation = rng.normal(3, 4, NUM_ACTIONS).astype(np.float32)
        scaled = (observation - np.array(moments.mean)) / np.sqrt(np.array(moments.var) + 1e-8)
        scaled = np.clip(scaled, -10, 10).astype(np.float32)
        action = planner.act(observation, {})
        assert env.mask[action]
        if run.algorithm == "maskable_ppo":
            expected, _ = model.predict(scaled, action_masks=env.mask, deterministic=True)
            assert action == expected
        else:
            env.mask[:] = True
            expected, _ = model.predict(scaled, deterministic=True)
            assert planner.act(observation, {}) == expected


def test_the_planner_draws_by_its_seed_and_respects_the_mask(run):
    path = str(run.out / "latest.zip")
    observations = np.random.default_rng(1).normal(3, 4, (60, NUM_ACTIONS)).astype(np.float32)

    def actions(seed):
        env = fake_env(seed=3)
        planner = TrainedFeaturesPolicy(env, seed, path=path)
        drawn = [planner.act(observation, {}) for observation in observations]
        assert all(env.mask[action] for action in drawn)
        return drawn

    assert actions(5) == actions(5)
    assert actions(5) != actions(6)


def test_probabilities_survive_the_file(run, tmp_path):
    """Saving what was loaded gives the same policy."""
    path = run.out / "latest.zip"
    model = artefact.ALGORITHMS[run.algorithm].load(path)
    metadata = artefact.load_metadata(path)
    artefact.save(tmp_path / "copy.zip", model, metadata)
    assert artefact.load_metadata(tmp_path / "copy.zip") == metadata
    observations = np.random.default_rng(2).normal(3, 4, (50, NUM_ACTIONS))
    masks = np.ones((50, NUM_ACTIONS), dtype=bool)
    first = artefact.Policy.load(path).probabilities(observations, masks)
    second = artefact.Policy.load(tmp_path / "copy.zip").probabilities(observations, masks)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(first.sum(axis=1), 1)


def test_resume_continues_the_count_and_the_curve(run, tmp_path):
    for name in ("latest.zip", "learning_curve.json"):
        (tmp_path / name).write_bytes((run.out / name).read_bytes())
    more = arguments(tmp_path, "--resume", steps=128, algorithm=run.algorithm)
    assert train_sb3.main(more) == 0
    metadata = artefact.load_metadata(tmp_path / "latest.zip")
    assert metadata.timesteps == 128
    assert metadata.observation_moments.count == pytest.approx(128, abs=4)  # two resets
    before, after = read_curve(run.out), read_curve(tmp_path)
    assert after["points"][:3] == before["points"]
    assert [point["timesteps"] for point in after["points"]] == [0, 32, 64, 96, 128]
    minutes = [point["minutes"] for point in after["points"]]
    assert minutes == sorted(minutes)


def test_the_return_rises_above_random_walk(tmp_path):
    more = ("--learning-rate", "0.003", "--n-epochs", "8", "--eval-every", "0")
    assert train_sb3.main([*arguments(tmp_path, steps=768), *more]) == 0
    curve = read_curve(tmp_path)
    first, last = curve["points"]
    assert last["return"] > 1.5 * curve["references"]["random walk"]["return"]
    assert last["return"] > first["return"]
    assert artefact.load_metadata(tmp_path / "best.zip").timesteps == 768


def test_interrupt_saves_and_says_so(tmp_path, monkeypatch):
    step = LearnableFake.step

    def step_and_interrupt(self, action):
        if self.split == "train" and len(steps_seen) == 40:
            os.kill(os.getpid(), signal.SIGINT)
        if self.split == "train":
            steps_seen.append(action)
        return step(self, action)

    steps_seen = []
    monkeypatch.setattr(LearnableFake, "step", step_and_interrupt)
    before = signal.getsignal(signal.SIGINT)
    assert train_sb3.main(arguments(tmp_path, steps=1000)) == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert artefact.load_metadata(tmp_path / "latest.zip").timesteps == 41


def test_the_clock_ends_training(tmp_path):
    assert train_sb3.main([*arguments(tmp_path, steps=10**6), "--minutes", "0"]) == 0
    assert artefact.load_metadata(tmp_path / "latest.zip").timesteps == 1


@pytest.mark.parametrize(("more", "ends"), [((), "64/64"), (("--minutes", "0.02"), "1/1 ")])
def test_bars_count_reference_episodes_then_steps_or_seconds(tmp_path, capsys, more, ends):
    steps = 10**6 if more else 64
    assert train_sb3.main([*arguments(tmp_path, steps=steps), *more]) == 0
    shown = capsys.readouterr().err
    episodes = read_curve(tmp_path)["eval_episodes"]
    assert f"{3 * episodes}/{3 * episodes}" in shown
    assert "reference: greedy" in shown
    assert ends in shown.replace("\r", "\n").splitlines()[-1]


def test_an_unknown_environment_lists_the_known_ones(tmp_path, capsys):
    words = arguments(tmp_path)
    words[words.index(ENV_ID)] = "MSActiveSLAM-v9"
    assert train_sb3.main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("ms-slam train: error: unknown environment 'MSActiveSLAM-v9'; valid")
    assert "MSActiveSLAM-v0, MSActiveSLAM-FreeCamera-v0" in error


def test_a_run_is_not_overwritten(run, capsys):
    assert train_sb3.main(arguments(run.out, algorithm=run.algorithm)) == 2
    assert "--resume" in capsys.readouterr().err


def test_resume_needs_a_run_with_the_same_options(run, tmp_path, capsys):
    assert train_sb3.main(arguments(tmp_path, "--resume")) == 2
    assert "no policy file" in capsys.readouterr().err
    more = arguments(run.out, "--resume", "--observation", "lookahead", algorithm=run.algorithm)
    assert train_sb3.main(more) == 2
    assert "'features', not 'lookahead'" in capsys.readouterr().err
    other = arguments(run.out, "--resume", "--eval-episodes", "5", algorithm=run.algorithm)
    assert train_sb3.main(other) == 2
    assert "eval_episodes = " in capsys.readouterr().err


@pytest.mark.parametrize("option", ["num-envs", "n-steps", "gamma", "minutes"])
def test_numbers_out_of_range_are_refused(option, tmp_path, capsys):
    assert train_sb3.main([*arguments(tmp_path), f"--{option}", "-1"]) == 2
    error = capsys.readouterr().err
    assert f"Args.{option.replace('-', '_')} = -1" in error
    assert len(error.splitlines()) == 1


def test_the_planner_refuses_what_it_cannot_run(run, tmp_path, monkeypatch):
    path = str(run.out / "latest.zip")
    monkeypatch.delenv("MS_SLAM_POLICY", raising=False)
    with pytest.raises(InputError, match="MS_SLAM_POLICY"):
        TrainedFeaturesPolicy(fake_env())
    with pytest.raises(InputError, match="no policy file"):
        TrainedFeaturesPolicy(fake_env(), path=str(tmp_path / "none.zip"))
    with pytest.raises(InputError, match=r"planner policy runs .* use policy-features"):
        TrainedPolicy(fake_env(), path=path)
    with pytest.raises(InputError, match="7 actions, the environment has 49"):
        TrainedFeaturesPolicy(fake_env(49), path=path)
    with pytest.raises(InputError, match="true, false"):
        TrainedFeaturesPolicy(fake_env(), path=path, deterministic="maybe")
    (tmp_path / "text.zip").write_text("not an archive")
    with pytest.raises(InputError, match="not a policy"):
        TrainedFeaturesPolicy(fake_env(), path=str(tmp_path / "text.zip"))
    monkeypatch.setenv("MS_SLAM_POLICY", path)
    assert TrainedFeaturesPolicy(fake_env()).policy.num_actions == NUM_ACTIONS
