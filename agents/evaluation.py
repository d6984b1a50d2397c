"""Play fixed validation episodes with a policy, and with reference planners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from ms_slam_agents.policy import (
    Actions,
    Policy,
    action_parts,
    joined,
    most_probable,
    sample,
    split,
)
from ms_slam_baselines.greedy import distance_to_targets
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from ms_slam_env._runtime.progress import Bar

Choose = Callable[
    [NDArray[Any], NDArray[np.bool_], Sequence[np.random.Generator], NDArray[np.bool_]], Actions
]
"""Observations (B, k), masks (B, n), a generator an episode, and which episodes begin (B,), to
actions (B,) or (B, numbers)."""

_STREAM = 1  # stream of an episode's seed for the policy; the environment uses the seed itself


class FixedEpisodes(gym.Wrapper[Any, Any, Any, Any]):
    """Plays a fixed list of seeded episodes; ``restart`` goes back to the first."""

    def __init__(self, env: gym.Env[Any, Any], seeds: Sequence[int]) -> None:
        super().__init__(env)
        self.seeds = list(seeds)
        self._next = 0

    def restart(self) -> None:
        """Make the next reset play the first episode."""
        self._next = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episode of the list, ignoring ``seed``."""
        seed = self.seeds[self._next % len(self.seeds)]
        self._next += 1
        return self.env.reset(seed=seed, options=options)


def evaluate(
    venv: VecEnv, num_episodes: int, choose: Choose, played_one: Callable[[], Any] | None = None
) -> dict[str, Any]:
    """Play every validation episode once; return means, and each episode's return in ``returns``.

    Random draws in an episode depend on its seed alone. A network has the same score in every
    evaluation and with any number of processes, and all networks get the same random numbers.

    Args:
        venv: parallel ``FixedEpisodes``.
        num_episodes: number of episodes in all environments together.
        choose: see ``Choose``.
        played_one: called after each episode.
    """
    venv.env_method("restart")
    observations = np.asarray(venv.reset())
    seeds = venv.get_attr("seeds")
    to_play = np.array([len(own) for own in seeds])
    returns, steps, lost = np.zeros((3, venv.num_envs))
    rngs = [_stream(own[0]) for own in seeds]
    episodes: dict[int, dict[str, float]] = {}  # by place in the list of seeds
    played = np.zeros(venv.num_envs, dtype=int)
    while len(episodes) < num_episodes:
        masks = np.stack(venv.env_method("action_masks"))
        actions = choose(observations, masks, rngs, steps == 0)
        observations, rewards, dones, infos = venv.step(actions)  # type: ignore[assignment]
        returns += rewards
        steps += 1
        lost += [not info["tracking_ok"] for info in infos]
        for i in np.flatnonzero(dones & (played < to_play)):
            episodes[int(i + played[i] * venv.num_envs)] = {
                "return": returns[i],
                "steps": steps[i],
                "mapped_area_m2": infos[i]["mapped_area"],
                "ate_unaligned_m": infos[i]["ate"],
                "lost_steps_share": lost[i] / steps[i],
                "terminated": float(not infos[i]["TimeLimit.truncated"]),
            }
            if played_one is not None:
                played_one()
        played[dones] += 1
        returns[dones] = steps[dones] = lost[dones] = 0
        for i in np.flatnonzero(dones):
            rngs[i] = _stream(seeds[i][played[i] % len(seeds[i])])
    ordered = [episodes[place] for place in range(num_episodes)]
    means = {name: float(np.mean([e[name] for e in ordered])) for name in ordered[0]}
    return means | {"returns": [float(e["return"]) for e in ordered]}


def _stream(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, _STREAM])


def evaluate_policy(
    venv: VecEnv, num_episodes: int, policy: Policy, deterministic: bool = False
) -> dict[str, Any]:
    """``evaluate`` a trained policy that samples its actions, or takes the most probable."""

    memory = policy.empty_memory(venv.num_envs)

    def choose(
        observations: NDArray[Any],
        masks: NDArray[np.bool_],
        rngs: Sequence[np.random.Generator],
        begins: NDArray[np.bool_],
    ) -> Actions:
        nonlocal memory
        memory = policy.remember(observations, np.where(begins[:, None], 0, memory))
        probabilities = policy.probabilities(observations, masks, memory)
        if deterministic:
            return most_probable(probabilities, policy.parts)
        return sample(probabilities, rngs, policy.parts)

    return evaluate(venv, num_episodes, choose)


def paired_gain(returns: Sequence[float], reference: Sequence[float]) -> dict[str, float]:
    """Mean gain over a reference on the same episodes, and its standard error.

    Episodes differ far more from each other than planners do on one episode, so pairs need fewer
    episodes to show whether a policy is better.
    """
    gain = np.subtract(returns, reference)
    error = float(np.std(gain)) / max(1, len(gain) - 1) ** 0.5
    return {"return_gain": float(np.mean(gain)), "return_gain_sem": error}


def references(venv: VecEnv, num_episodes: int) -> dict[str, dict[str, Any]]:
    """Scores of random walk, standing still and the greedy planner on the same episodes.

    Where an action also sets the SLAM configuration, random walk draws that too, and the other two
    keep the last, most robust one.
    """
    targets = venv.get_attr("config")[0].targets
    parts = action_parts(venv.action_space)

    def whole(motions: Actions) -> Actions:
        others = [np.full(len(motions), count - 1) for count in parts[1:]]
        return joined([motions, *others])

    def random_walk(_: Any, masks: NDArray[np.bool_], rngs: Any, __: Any) -> Actions:
        uniform = [part / part.sum(axis=1, keepdims=True) for part in split(masks, parts)]
        return sample(np.concatenate(uniform, axis=1), rngs, parts)

    def stationary(_: Any, masks: NDArray[np.bool_], *__: Any) -> Actions:
        return whole(np.zeros(len(masks), dtype=np.int64))

    def greedy(_: Any, masks: NDArray[np.bool_], *__: Any) -> Actions:
        delta_I, delta_D = np.moveaxis(np.stack(venv.env_method("lookahead")), -1, 0)
        possible = split(masks, parts)[0]
        distance = np.where(possible, distance_to_targets(delta_I, delta_D, targets), np.inf)
        return whole(np.argmin(distance, axis=1))

    planners = {"random walk": random_walk, "stationary": stationary, "greedy": greedy}
    results = {}
    with Bar(total=len(planners) * num_episodes, desc="references", unit="episode") as bar:
        for name, choose in planners.items():
            bar.set_description(f"reference: {name}")
            results[name] = evaluate(venv, num_episodes, choose, bar.update)
    return results
