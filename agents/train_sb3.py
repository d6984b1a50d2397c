"""Train a camera-motion policy with PPO (Stable-Baselines3), with or without action masks.

    ms-slam train sb3 --out runs/ppo --minutes 60

Top to bottom: environments, training; the options are in ``options.py``. Writes into ``out``:
``latest.zip`` (to resume from) and ``best.zip`` (highest validation return), both fit for
``ms_slam_agents.policy_planner``, the learning curve as JSON, CSV and PNG with random walk,
standing still and the greedy planner on the same validation episodes as references, and logs for
TensorBoard.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from ms_slam_agents import artefact
from ms_slam_agents.evaluation import (
    Actions,
    FixedEpisodes,
    evaluate,
    most_probable,
    paired_gain,
    references,
    sample,
)
from ms_slam_agents.learning_curve import write_curve
from ms_slam_agents.options import Args
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
)
from tqdm import tqdm

import ms_slam_env  # registers the ids, in a worker process too
from ms_slam_env.command_line import parse
from ms_slam_env.errors import InputError, unknown

VALIDATION_SEED = 1_000_000  # of the first validation episode; training draws from small seeds


# -- Environments ------------------------------------------------------------------------------


def make_env(args: Args, split: str, seeds: Sequence[int]) -> gym.Env[Any, Any]:
    """Build one environment; with ``seeds`` it plays those episodes only."""
    if multiprocessing.parent_process() is not None:  # in a worker Ctrl-C is the main's to answer
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.set_num_threads(1)
    options: dict[str, Any] = {}
    if args.embodiment is not None:
        options["embodiment"] = args.embodiment
    if args.step_m is not None:
        options["step_m"] = args.step_m
    if args.step_deg is not None:
        options["step_rad"] = math.radians(args.step_deg)
    env = gym.make(
        args.env_id,
        max_episode_steps=args.episode_steps,
        disable_env_checker=True,
        scene=args.scenes,
        split=split,
        num_scene_seeds=args.scene_seeds,
        observation=args.observation,
        **options,
    )
    return FixedEpisodes(env, seeds) if seeds else env


def make_venv(args: Args, split: str, seeds: Sequence[int] = ()) -> VecEnv:
    """Build the parallel environments; the episodes ``seeds`` are dealt out to them in turn."""
    num_envs = min(args.num_envs, len(seeds)) if seeds else args.num_envs

    def maker(rank: int) -> Callable[[], gym.Env[Any, Any]]:
        return lambda: make_env(args, split, seeds[rank::num_envs])

    makers = [maker(rank) for rank in range(num_envs)]
    if num_envs == 1:
        return DummyVecEnv(makers)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # inherited by the workers
    return SubprocVecEnv(makers, start_method="spawn")


# -- Training ----------------------------------------------------------------------------------


class Supervisor(BaseCallback):
    """Stops by the clock or a signal, saves after each update, evaluates every so often."""

    def __init__(self, args: Args, validation: VecEnv, curve: dict[str, Any]) -> None:
        super().__init__()
        self.args = args
        self.validation = validation
        self.curve = curve
        self.stop_reason = ""
        self._minutes_before = curve["points"][-1]["minutes"] if curve["points"] else 0.0

    def stop(self, reason: str) -> None:
        """End training after the current step."""
        self.stop_reason = self.stop_reason or reason

    @property
    def minutes(self) -> float:
        """Wall-clock time of this run so far."""
        return (time.monotonic() - self._start) / 60

    def _on_training_start(self) -> None:
        self._start = time.monotonic()
        if self.args.minutes is None:
            self._bar = tqdm(
                total=self.args.total_timesteps,
                initial=self.num_timesteps,
                unit="step",
                smoothing=0.1,
            )
        else:
            self._bar = tqdm(total=round(60 * self.args.minutes), unit="s")
        self._next_evaluation = self.num_timesteps
        if self.curve["points"] and self.curve["points"][-1]["timesteps"] == self.num_timesteps:
            self._plan_evaluation()  # resumed where it was evaluated

    def _on_rollout_start(self) -> None:
        self.save("latest.zip")
        if self.num_timesteps >= self._next_evaluation:
            self._evaluate()
            self._plan_evaluation()

    def _on_step(self) -> bool:
        self._show_progress()
        terms: dict[str, list[float]] = {}
        for info in self.locals["infos"]:
            for name, value in info["reward_terms"].items():
                terms.setdefault(name, []).append(value)
        for name, values in terms.items():
            self.logger.record_mean(f"reward/{name}", float(np.mean(values)))
        if self.args.minutes is not None and self.minutes >= self.args.minutes:
            self.stop("time is up")
        return not self.stop_reason

    def _show_progress(self) -> None:
        """Move the bar: it counts seconds where time ends the run, steps otherwise."""
        if self.args.minutes is None:
            self._bar.update(self.training_env.num_envs)
            return
        self._bar.set_postfix_str(f"{self.num_timesteps} steps", refresh=False)
        seconds = min(round(60 * self.args.minutes), int(60 * self.minutes))
        self._bar.update(seconds - self._bar.n)

    def _on_training_end(self) -> None:
        self.save("latest.zip")
        if not self.stop_reason.startswith("interrupt"):
            points = self.curve["points"]
            if not points or points[-1]["timesteps"] < self.num_timesteps:
                self._evaluate()
        self._bar.close()

    def save(self, name: str) -> None:
        """Write the policy as it is now into the run's folder."""
        normalize = self.model.get_vec_normalize_env()
        assert isinstance(self.model, (PPO, MaskablePPO))
        assert normalize is not None
        metadata = artefact.Metadata(
            algorithm=self.args.algorithm,
            env_id=self.args.env_id,
            observation=self.args.observation,
            observation_moments=artefact.Moments.of(normalize.obs_rms),
            return_moments=artefact.Moments.of(normalize.ret_rms),
            timesteps=self.num_timesteps,
            minutes=self._minutes_before + self.minutes,
            options=json.loads(json.dumps(asdict(self.args), default=str)),
        )
        artefact.save(self.args.out / name, self.model, metadata)

    def _plan_evaluation(self) -> None:
        every = self.args.eval_every
        done = self.num_timesteps
        self._next_evaluation = (done // every + 1) * every if every else sys.maxsize

    def _evaluate(self) -> None:
        policy = artefact.Policy.load(self.args.out / "latest.zip")
        rng = np.random.default_rng(self.args.seed)

        def choose(observations: NDArray[Any], masks: NDArray[np.bool_]) -> Actions:
            probabilities = policy.probabilities(observations, masks)
            if self.args.deterministic_eval:
                return most_probable(probabilities, policy.parts)
            return sample(probabilities, rng, policy.parts)

        result = evaluate(self.validation, self.args.eval_episodes, choose)
        random_walk = self.curve["references"]["random walk"]
        result |= paired_gain(result.pop("returns"), random_walk["returns"])
        best = max((point["return"] for point in self.curve["points"]), default=-np.inf)
        if result["return"] > best:
            self.save("best.zip")
        minutes = self._minutes_before + self.minutes
        self.curve["points"].append(
            {"timesteps": self.num_timesteps, "minutes": round(minutes, 3)} | result
        )
        write_curve(self.args.out, self.curve)
        for name, value in result.items():
            self.logger.record(f"validation/{name}", value)
        self._bar.write(
            f"{self.num_timesteps} steps, {minutes:.1f} min: validation return "
            f"{result['return']:.2f}, {result['gain']:+.2f} ± {result['gain_sem']:.2f} over random "
            f"walk's {random_walk['return']:.2f}; "
            f"mapped {result['mapped_area_m2']:.1f} m2, lost {result['lost']:.0%}"
        )


def make_model(args: Args, venv: VecEnv) -> PPO | MaskablePPO:
    """Build the model on normalised environments, new or from ``out/latest.zip``.

    Raises:
        InputError: nothing to resume from, or it was trained with other options.
    """
    normalize = VecNormalize(VecMonitor(venv), gamma=args.gamma)
    algorithm = artefact.ALGORITHMS[args.algorithm]
    log = str(args.out / "tensorboard")
    if not args.resume:
        model = algorithm(
            "MlpPolicy",
            normalize,
            learning_rate=args.learning_rate,
            n_steps=args.n_steps,
            batch_size=args.batch_size,
            n_epochs=args.n_epochs,
            gamma=args.gamma,
            gae_lambda=args.gae_lambda,
            ent_coef=args.ent_coef,
            clip_range=args.clip_range,
            policy_kwargs={"net_arch": [args.hidden, args.hidden]},
            tensorboard_log=log,
            seed=args.seed,
            device="cpu",
        )
        return model
    metadata = artefact.load_metadata(args.out / "latest.zip")
    for name in ("algorithm", "env_id", "observation"):
        if getattr(args, name) != getattr(metadata, name):
            raise InputError(
                f"{args.out / 'latest.zip'} was trained with {name} {getattr(metadata, name)!r}, "
                f"not {getattr(args, name)!r}"
            )
    metadata.observation_moments.restore(normalize.obs_rms)
    metadata.return_moments.restore(normalize.ret_rms)
    seed = args.seed + metadata.timesteps  # go on with new episodes, not with the first again
    model = algorithm.load(
        args.out / "latest.zip", env=normalize, device="cpu", tensorboard_log=log, seed=seed
    )
    return model


def load_curve(args: Args, validation: VecEnv) -> dict[str, Any]:
    """Return the learning curve so far: that of the run to resume, or references and no points.

    Raises:
        InputError: the run to resume was evaluated on another number of episodes.
    """
    path = args.out / "learning_curve.json"
    if args.resume and path.is_file():
        curve: dict[str, Any] = json.loads(path.read_text())
        if curve["eval_episodes"] != args.eval_episodes:
            raise InputError(
                f"{path} has points of eval_episodes = {curve['eval_episodes']} each, "
                f"not {args.eval_episodes}"
            )
        return curve
    return {
        "eval_episodes": args.eval_episodes,
        "references": references(validation, args.eval_episodes, args.seed),
        "points": [],
    }


def train(args: Args) -> int:
    """Train as ``args`` say; return the exit status, 130 after an interrupt."""
    torch.set_num_threads(1)
    if not args.resume and (args.out / "latest.zip").exists():
        raise InputError(f"{args.out} holds a training run already: add --resume, or change --out")
    try:
        make_env(args, "train", ()).close()  # bad options fail here, not in a worker process
    except gym.error.UnregisteredEnv:
        raise unknown("environment", args.env_id, ms_slam_env.ENV_IDS) from None
    except gym.error.Error as error:
        raise InputError(f"environment {args.env_id!r} cannot be made: {error}") from None
    args.out.mkdir(parents=True, exist_ok=True)
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + args.eval_episodes)
    validation = make_venv(args, "validation", seeds)
    training = make_venv(args, "train")
    handlers: dict[int, Any] = {}
    try:
        model = make_model(args, training)
        supervisor = Supervisor(args, validation, load_curve(args, validation))

        def interrupt(number: int, _: object) -> None:
            signal.signal(number, handlers[number])  # a second one ends at once
            supervisor.stop(f"interrupted by {signal.Signals(number).name}")

        for number in (signal.SIGINT, signal.SIGTERM):
            handlers[number] = signal.signal(number, interrupt)
        model.learn(
            max(0, args.total_timesteps - model.num_timesteps),
            callback=supervisor,
            tb_log_name=args.algorithm,
            reset_num_timesteps=not args.resume,
        )
    finally:
        for caught, handler in handlers.items():
            signal.signal(caught, handler)
        training.close()
        validation.close()
    print(f"{supervisor.stop_reason or 'done'}: {model.num_timesteps} steps, policy in {args.out}")
    return 130 if supervisor.stop_reason.startswith("interrupt") else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, 2 on bad input, 130 after an interrupt."""
    try:
        return train(parse(Args, argv, "ms-slam train"))
    except InputError as error:
        print(f"ms-slam train: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "ms-slam train: interrupted; what was trained before the last update is saved",
            file=sys.stderr,
        )
        return 130


if __name__ == "__main__":
    sys.exit(main())
