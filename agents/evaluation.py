"""Play fixed validation episodes with a policy, and with reference planners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from ms_slam_agents.artefact import action_parts
from ms_slam_baselines.greedy import distance_to_targets
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

Actions = NDArray[np.int64]
Choose = Callable[[NDArray[Any], NDArray[np.bool_]], Actions]  # observations, masks -> actions
"""Actions are (B,), or (B, numbers) where each has several."""


class FixedEpisodes(gym.Wrapper[Any, Any, Any, Any]):
    """Plays the same seeded episodes each time round; ``restart`` goes back to the first."""

    def __init__(self, env: gym.Env[Any, Any], seeds: Sequence[int]) -> None:
        super().__init__(env)
        self.seeds = list(seeds)
        self._next = 0

    def restart(self) -> None:
        """Let the next reset play the first episode."""
        self._next = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episode of the list, whatever ``seed`` says."""
        seed = self.seeds[self._next % len(self.seeds)]
        self._next += 1
        return self.env.reset(seed=seed, options=options)


def evaluate(
    venv: VecEnv, num_episodes: int, choose: Choose, played_one: Callable[[], Any] | None = None
) -> dict[str, Any]:
    """Play every validation episode once; means over episodes, and ``returns`` one by one.

    Args:
        venv: of ``FixedEpisodes``.
        num_episodes: in all environments together.
        choose: maps observations (B, k) and masks (B, n) to actions (B,).
        played_one: called after each episode.
    """
    venv.env_method("restart")
    observations = np.asarray(venv.reset())
    to_play = np.array([len(seeds) for seeds in venv.get_attr("seeds")])
    returns, steps, tracked = np.zeros((3, venv.num_envs))
    episodes: dict[int, dict[str, float]] = {}  # by place in the list of seeds
    played = np.zeros(venv.num_envs, dtype=int)
    while len(episodes) < num_episodes:
        masks = np.stack(venv.env_method("action_masks"))
        observations, rewards, dones, infos = venv.step(choose(observations, masks))  # type: ignore[assignment]
        returns += rewards
        steps += 1
        tracked += [info["tracking_ok"] for info in infos]
        for i in np.flatnonzero(dones & (played < to_play)):
            episodes[int(i + played[i] * venv.num_envs)] = {
                "return": returns[i],
                "steps": steps[i],
                "mapped_area_m2": infos[i]["mapped_area"],
                "ate_unaligned_m": infos[i]["ate"],
                "tracked_share": tracked[i] / steps[i],
                "lost": float(not infos[i]["TimeLimit.truncated"]),
            }
            if played_one is not None:
                played_one()
        played[dones] += 1
        returns[dones] = steps[dones] = tracked[dones] = 0
    ordered = [episodes[place] for place in range(num_episodes)]
    means = {name: float(np.mean([e[name] for e in ordered])) for name in ordered[0]}
    return means | {"returns": [float(e["return"]) for e in ordered]}


def paired_gain(returns: Sequence[float], reference: Sequence[float]) -> dict[str, float]:
    """Mean gain over a reference on the same episodes, and its standard error.

    Episodes differ far more among themselves than planners do on one of them: the pairs tell
    sooner whether a policy is better.
    """
    gain = np.subtract(returns, reference)
    error = float(np.std(gain)) / max(1, len(gain) - 1) ** 0.5
    return {"gain": float(np.mean(gain)), "gain_sem": error}


def sample(
    probabilities: NDArray[Any], rng: np.random.Generator, parts: Sequence[int] = ()
) -> Actions:
    """Draw one action a row of ``probabilities`` (B, n).

    With several ``parts``, choices of each number of an action, (B, numbers).
    """
    drawn = [[rng.choice(len(row), p=row) for row in part] for part in _split(probabilities, parts)]
    return _joined(drawn)


def most_probable(probabilities: NDArray[Any], parts: Sequence[int] = ()) -> Actions:
    """The most probable action of each row of ``probabilities`` (B, n), as ``sample`` has them."""
    return _joined([np.argmax(part, axis=1) for part in _split(probabilities, parts)])


def _split(values: NDArray[Any], parts: Sequence[int]) -> list[NDArray[Any]]:
    return np.split(values, np.cumsum(parts)[:-1], axis=1) if len(parts) > 1 else [values]


def _joined(numbers: Sequence[Any]) -> Actions:
    return np.stack(numbers, axis=1) if len(numbers) > 1 else np.array(numbers[0])


def references(venv: VecEnv, num_episodes: int, seed: int) -> dict[str, dict[str, Any]]:
    """What random walk, standing still and the greedy planner reach on the same episodes.

    Where an action has a second number, the SLAM configuration, random walk draws that too and the
    other two keep to the last, the most robust.
    """
    rng = np.random.default_rng(seed)
    targets = venv.get_attr("config")[0].targets
    parts = action_parts(venv.action_space)

    def whole(motions: Actions) -> Actions:
        others = [np.full(len(motions), count - 1) for count in parts[1:]]
        return _joined([motions, *others])

    def random_walk(_: NDArray[Any], masks: NDArray[np.bool_]) -> Actions:
        split = _split(masks, parts)
        uniform = [part / part.sum(axis=1, keepdims=True) for part in split]
        return sample(np.concatenate(uniform, axis=1), rng, parts)

    def stationary(_: NDArray[Any], masks: NDArray[np.bool_]) -> Actions:
        return whole(np.zeros(len(masks), dtype=np.int64))

    def greedy(_: NDArray[Any], masks: NDArray[np.bool_]) -> Actions:
        delta_I, delta_D = np.moveaxis(np.stack(venv.env_method("lookahead")), -1, 0)
        possible = _split(masks, parts)[0]
        distance = np.where(possible, distance_to_targets(delta_I, delta_D, targets), np.inf)
        return whole(np.argmin(distance, axis=1))

    planners = {"random walk": random_walk, "stationary": stationary, "greedy": greedy}
    results = {}
    with tqdm(total=len(planners) * num_episodes, unit="episode") as bar:
        for name, choose in planners.items():
            bar.set_description(f"reference: {name}")
            results[name] = evaluate(venv, num_episodes, choose, bar.update)
    return results
