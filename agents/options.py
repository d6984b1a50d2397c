"""Options of the training script."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError


@dataclass(frozen=True)
class Args:
    """Train a camera-motion policy with PPO; these options are the command line.

    Attributes:
        out: folder for everything the run writes.
        resume: go on from ``out/latest.zip``, with the learning settings saved in it.
        algorithm: PPO over the actions that are not blocked, or over all of them.
        env_id: id of the environment.
        embodiment: what carries the camera; None: what the id says.
        observation: ``lookahead`` shows the agent what the greedy planner sees, ``features`` is
            cheaper.
        scenes: trained and validated on, with training and validation seeds.
        scene_seeds: seeds of each scene, from the split's first; a scene takes seconds to build.
        episode_steps: time limit of an episode.
        step_m: translation of a motion; None: the environment's default.
        step_deg: rotation of a motion; None: the environment's default.
        num_envs: parallel environments, one process and one thread each.
        seed: of network, training episodes and sampling.
        total_timesteps: environment steps, all runs of a resumed training together.
        minutes: stop this run after training for so much wall-clock time, the evaluations during
            it included; the episodes of the references before, and the last evaluation after it,
            come on top. None: by steps alone.
        eval_every: environment steps between evaluations; 0: only first and last.
        eval_episodes: validation episodes, the same at each evaluation.
        deterministic_eval: evaluate the most probable action instead of sampling.
        n_steps: steps of each environment between updates.
        batch_size: of the gradient steps.
        n_epochs: passes over the data of one update.
        learning_rate: of Adam.
        gamma: discount factor.
        gae_lambda: trade-off between bias and variance of the advantages.
        ent_coef: weight of the entropy bonus.
        clip_range: of PPO's objective.
        hidden: width of the two hidden layers.
    """

    out: Path = Path("runs/sb3")
    resume: bool = False
    algorithm: Literal["maskable_ppo", "ppo"] = "maskable_ppo"
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    embodiment: str | None = None
    observation: Literal["features", "lookahead"] = "lookahead"
    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    scene_seeds: int = 4
    episode_steps: int = 150
    step_m: float | None = None
    step_deg: float | None = None
    num_envs: int = 2
    seed: int = 0
    total_timesteps: int = 200_000
    minutes: float | None = None
    eval_every: int = 10_000
    eval_episodes: int = 12
    deterministic_eval: bool = False
    n_steps: int = 512
    batch_size: int = 128
    n_epochs: int = 8
    learning_rate: float = 3e-4
    gamma: float = 0.98
    gae_lambda: float = 0.95
    ent_coef: float = 0.003
    clip_range: float = 0.2
    hidden: int = 128

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        for name in ("scene_seeds", "episode_steps", "num_envs", "eval_episodes", "hidden"):
            check_range(self, name, 1, 100_000)
        for name in ("n_steps", "batch_size"):
            check_range(self, name, 2, 1_000_000)  # advantages of one sample have no spread
        for name in ("total_timesteps", "eval_every"):
            check_range(self, name, 0, 1_000_000_000)
        check_range(self, "n_epochs", 1, 1000)
        for name in ("learning_rate", "gamma", "gae_lambda", "ent_coef", "clip_range"):
            check_range(self, name, 0, 1)
        if self.minutes is not None:
            check_range(self, "minutes", 0, 1_000_000)
        if not self.scenes:
            raise InputError("Args.scenes names no scene")
