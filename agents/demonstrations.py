"""Episodes labelled with a planner's actions, for imitation learning."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.input_files import MAX_MESH_BYTES, check_file
from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.env.planners import Planner, make_planner
from ms_slam_env.errors import InputError
from ms_slam_env.slam.shared.state_file import check_expansion

_PLANNER, _POLICY = 1, 2  # streams of an episode's seed; the environment draws from the seed itself
_ARRAYS = {"observations": 2, "masks": 2, "preferences": 2, "rewards": 1, "is_tracked": 1}


@dataclass(frozen=True)
class Task:
    """One episode to play.

    Attributes:
        path: output file.
        env_id: of the environment.
        options: of ``gym.make``; a process keeps its environment while they stay the same.
        seed: of the episode.
        teacher: a planner, ``NAME,option=value,...``.
        policy: file of the policy that acts; None: the teacher acts.
        share: share of the decisions that the teacher makes when a policy acts.
        through: planner with the option ``path`` through which the policy acts; decisions that the
            teacher does not rate are then not learned from. None: the policy acts by itself.
    """

    path: Path
    env_id: str
    options: tuple[tuple[str, Any], ...]
    seed: int
    teacher: str
    policy: Path | None = None
    share: float = 0.0
    through: str | None = None


@dataclass(frozen=True)
class Demonstration:
    """Observations of T steps, and the actions that the teacher would have taken.

    Attributes:
        observations: (T, k) float16.
        masks: (T, n) bool, the possible actions.
        preferences: (T, n) float16, the teacher's probabilities of the actions; all zero for steps
            that are not learned from.
        rewards: (T,) of the actions taken.
        is_tracked: (T,) bool, whether SLAM knew its pose.
    """

    observations: NDArray[np.float16]
    masks: NDArray[np.bool_]
    preferences: NDArray[np.float16]
    rewards: NDArray[np.float32]
    is_tracked: NDArray[np.bool_]

    def write(self, path: Path) -> None:
        """Write a compressed NumPy archive atomically."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **{name: getattr(self, name) for name in _ARRAYS})
        write_bytes(path, buffer.getvalue())

    @staticmethod
    def read(path: Path) -> Demonstration:
        """Read a file written by ``write``; nothing in it is executed.

        Raises:
            InputError: no such file, or one that is not a demonstration.
        """
        try:
            check_file(path, "demonstration", MAX_MESH_BYTES)
            with zipfile.ZipFile(path) as archive:
                check_expansion(archive, path.stat().st_size)
            with np.load(path, allow_pickle=False) as found:
                made = Demonstration(**{name: found[name] for name in _ARRAYS})
            lengths = {len(getattr(made, name)) for name in _ARRAYS}
            kinds = {name: getattr(made, name).ndim for name in _ARRAYS}
        except Exception as error:  # a damaged archive can raise anything
            raise InputError(f"{path} is not a demonstration: {error}") from None
        if len(lengths) != 1 or kinds != _ARRAYS:
            raise InputError(f"{path} is not a demonstration: arrays that do not fit each other")
        return made

    def returns(self, gamma: float) -> NDArray[np.float64]:
        """Discounted sums (T,) of the rewards from each step on, 0 after the last."""
        sums = np.zeros(len(self.rewards) + 1)
        for t in range(len(self.rewards) - 1, -1, -1):
            sums[t] = self.rewards[t] + gamma * sums[t + 1]
        return sums[:-1]


_ENVS: dict[Any, gym.Env[Any, Any]] = {}


def play(task: Task) -> Path:
    """Play an episode, write it, and return its path.

    The teacher is queried at every step and told which action was taken instead (DAgger, Ross et
    al., AISTATS 2011).
    """
    key = (task.env_id, repr(task.options))  # a reward's weights are a dictionary
    if key not in _ENVS:
        import ms_slam_env  # noqa: F401 -- registers the ids, in a worker process too

        _ENVS[key] = gym.make(task.env_id, disable_env_checker=True, **dict(task.options))
    env = _ENVS[key]
    observation, info = env.reset(seed=task.seed)
    stream = np.random.default_rng([task.seed, _PLANNER])
    teacher = make_planner(task.teacher, env.unwrapped, seed=int(stream.integers(2**31)))
    teacher.reset()
    actor = _actor(task, env.unwrapped, int(stream.integers(2**31)))
    rng = np.random.default_rng([task.seed, _POLICY])
    steps: list[tuple[Any, ...]] = []
    is_over = False
    while not is_over:
        mask, is_tracked = np.array(info["action_mask"], dtype=bool), info["tracking_ok"]
        wanted = teacher.act(observation, teacher.known(info))
        preferences = teacher.preferences()
        if preferences is None:
            preferences = (np.arange(len(mask)) == wanted) & (task.through is None)
        action = actor.act(observation, actor.known(info)) if actor else wanted
        if actor and action != wanted:
            if rng.random() < task.share:
                action = wanted
                actor.instead(action)
            else:
                teacher.instead(action)
        seen = np.asarray(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        steps.append((seen, mask, preferences, reward, is_tracked))
        is_over = terminated or truncated
    columns = zip(*steps, strict=True)
    kinds = (np.float16, np.bool_, np.float16, np.float32, np.bool_)
    arrays: list[Any] = [
        np.array(column, dtype=kind) for column, kind in zip(columns, kinds, strict=True)
    ]
    Demonstration(*arrays).write(task.path)
    return task.path


def _actor(task: Task, env: Any, seed: int) -> Planner | None:
    """The initialized planner through which the policy acts; None where the teacher acts."""
    if task.policy is None:
        return None
    actor = make_planner(task.through or "policy", env, seed, path=str(task.policy))
    actor.reset()
    return actor
