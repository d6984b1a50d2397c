"""Supervise a training run: stop by the clock or a signal, save and evaluate the policy."""

from __future__ import annotations

import signal
import sys
import time

import numpy as np
from ms_slam_agents.learning_curve import LATEST, Curve
from ms_slam_agents.policy import action_parts
from ms_slam_agents.policy_file import PolicyFile, write_policy
from ms_slam_agents.sb3_state import Model, epochs_of, tensors_of, update_on_partial_rollout
from ms_slam_agents.trainers import Sb3Args as Args
from ms_slam_agents.training_run import metadata_of, stage_of
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from ms_slam_env._runtime.progress import Bar
from ms_slam_env.report.provenance import provenance


class Supervisor(BaseCallback):
    """Stops by the clock or a signal, saves after each update, evaluates every so often.

    Args:
        args: of the training script.
        validation: environments of ``FixedEpisodes``.
        curve: the learning curve so far.
        minutes_before: minutes trained by the runs that this one resumes.
    """

    model: Model

    def __init__(
        self,
        args: Args,
        validation: VecEnv,
        curve: Curve,
        minutes_before: float = 0.0,
    ) -> None:
        super().__init__()
        self.args = args
        self.validation = validation
        self.curve = curve
        self.stop_reason = ""
        self.signal: signal.Signals | None = None
        self.unlearnt_steps = 0
        self.was_done = False
        """Whether only the last evaluation remained."""
        self._minutes_before = minutes_before
        self._evaluation_s = 0.0
        self._next_save = 0
        self._provenance = provenance()
        self._bar = Bar(disable=True)

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.close()

    def stop(self, reason: str) -> None:
        """End training after the current step."""
        self.stop_reason = self.stop_reason or reason

    def interrupt(self, number: signal.Signals) -> None:
        """End training after the current step, since a signal came."""
        self.signal = number
        self.stop(f"interrupted by {number.name}")

    @property
    def minutes(self) -> float:
        """Wall-clock time that this run has trained, evaluations left out."""
        return (time.monotonic() - self._start - self._evaluation_s) / 60

    def _on_training_start(self) -> None:
        self._start = time.monotonic()
        self._epochs_before = self.model._n_updates
        self.was_done = self.num_timesteps >= self.args.total_timesteps
        if self.args.minutes is None:
            self._bar = Bar(
                total=self.args.total_timesteps,
                desc="training",
                initial=self.num_timesteps,
                unit="step",
                smoothing=0.1,
            )
        else:
            self._bar = Bar(total=round(60 * self.args.minutes), desc="training", unit="s")
        self._next_evaluation = self.num_timesteps
        if self._is_evaluated():
            self._plan_evaluation()  # resumed where it was evaluated

    @property
    def has_learnt(self) -> bool:
        """Whether this run has updated the network."""
        return self.model._n_updates > self._epochs_before

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next_save:
            self._save_latest()
        if self.num_timesteps >= self._next_evaluation:
            self._evaluate()
            self._plan_evaluation()
        if self.args.curriculum:
            stage = stage_of(self.args, self.num_timesteps, self.curve)
            self.training_env.env_method("enter_stage", stage)

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
        if self.stop_reason and not update_on_partial_rollout(self.model, self.args.batch_size):
            buffer = self.model.rollout_buffer
            self.unlearnt_steps = 0 if buffer.full else buffer.pos * buffer.n_envs
        self._save_latest()
        if self.has_learnt and not self.signal and not self._is_evaluated():
            self._evaluate()
        self._bar.close()

    def _is_evaluated(self) -> bool:
        return self.curve.steps == self.num_timesteps

    def _save_latest(self) -> None:
        write_policy(self.args.out / LATEST, self.policy_file())
        if self.args.algorithm == "dqn":  # whose rollouts are a few steps
            self._next_save = self.num_timesteps + self.args.save_every

    def policy_file(self) -> PolicyFile:
        """The current policy, with the state of the optimiser."""
        space = self.training_env.observation_space
        assert space.shape is not None
        metadata = metadata_of(
            self.args,
            self.args.algorithm,
            inputs=space.shape[0],
            actions=action_parts(self.training_env.action_space),
            timesteps=self.num_timesteps,
            epochs=epochs_of(self.model),
            quantiles=self.args.layers["quantiles"],
            minutes=self._minutes_before + self.minutes,
            provenance=self._provenance,
        )
        return PolicyFile(metadata, tensors_of(self.model))

    def _plan_evaluation(self) -> None:
        every = self.args.eval_every
        done = self.num_timesteps
        self._next_evaluation = (done // every + 1) * every if every else sys.maxsize

    def _evaluate(self) -> None:
        started = time.monotonic()
        file = self.policy_file().without_optimizer()
        minutes = file.metadata.minutes
        point = self.curve.judge(file, self.validation, self.args.out, self.args.deterministic_eval)
        for name in point.keys() - {"returns", "timesteps", "training_min"}:
            self.logger.record(f"validation/{name}", point[name])
        self._evaluation_s += time.monotonic() - started
        self._bar.write(
            f"{self.num_timesteps} steps, {minutes:.1f} min: {self.curve.in_words(point)}"
        )
