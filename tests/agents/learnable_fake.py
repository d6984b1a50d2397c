"""A small environment that can be learnt in seconds, and options to train in it."""

from types import SimpleNamespace
from typing import ClassVar

import gymnasium as gym
import numpy as np
from ms_slam_agents.learning_curve import read_curve as read_curve_file
from ms_slam_agents.policy_file import PolicyFile

from ms_slam_env.env.env_config import TargetConfig

NUM_ACTIONS = 7
ENV_ID = "LearnableFake-v0"
RECALL_ID = "LearnableRecall-v0"


class LearnableFake(gym.Env):
    """The observation names the right action, which is never blocked; half of the others are."""

    log: ClassVar[list] = []
    inputs: ClassVar[int] = NUM_ACTIONS

    def __init__(
        self,
        scene="",
        split="train",
        num_scene_seeds=1,
        observation="features",
        frame_divergences=True,
        episodes_per_scene=1,
    ):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.inputs,), np.float32)
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
            "action_mask": self.action_masks(),
        }


class Recall(LearnableFake):
    """The right action is what was named two steps before: without a memory nobody knows it."""

    def reset(self, *, seed=None, options=None):
        self.named = []
        return super().reset(seed=seed)

    def _next(self):
        observation = super()._next()
        self.named.append(self.right)
        self.right = self.named[max(0, len(self.named) - 3)]
        self.mask[:] = True
        return observation


gym.register(ENV_ID, LearnableFake)
gym.register(RECALL_ID, Recall)


def words_of(out, more, env_id=ENV_ID, **options):
    """A trainer's command line: a small network, one environment, short episodes, ``options``."""
    said = {
        "out": out,
        "env-id": env_id,
        "num-envs": 1,
        "episode-steps": 10,
        "batch-size": 16,
        "hidden": 16,
        **{name.replace("_", "-"): value for name, value in options.items()},
    }
    return [word for name, value in said.items() for word in (f"--{name}", str(value))] + [*more]


def arguments(out, *more, steps=64, algorithm="maskable_ppo"):
    learns = {"total_timesteps": steps, "eval_every": 32, "n_steps": 32, "n_epochs": 2}
    judged = {"algorithm": algorithm, "observation": "features", "eval_episodes": 3}
    return words_of(out, more, **learns, **judged)


def with_moments(network, metadata):
    """The policy file of a network whose inputs have mean 0.5 and standard deviation 2."""
    tensors = {f"policy.{n}": p.detach().numpy() for n, p in network.named_parameters()}
    for name, shape in (("observation", (metadata.inputs,)), ("return", ())):
        tensors |= {f"{name}.mean": np.full(shape, 0.5), f"{name}.var": np.full(shape, 4.0)}
        tensors |= {f"{name}.count": np.array(9.0)}
    return PolicyFile(metadata, tensors)


def read_curve(out):
    return read_curve_file(out / "results.json")


def fake_env(num_actions=NUM_ACTIONS, seed=0, inputs=NUM_ACTIONS):
    rng = np.random.default_rng(seed)
    mask = rng.random(num_actions) < 0.5
    mask[0] = True
    return SimpleNamespace(
        action_space=gym.spaces.Discrete(num_actions),
        observation_space=gym.spaces.Box(-np.inf, np.inf, (inputs,), np.float32),
        action_masks=lambda: mask.copy(),
        mask=mask,
    )
