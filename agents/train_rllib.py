"""PPO with action masks on Ray RLlib, for more than one machine.

    ms-slam train rllib --task room --num-envs 4 --out runs/rllib
    ms-slam train rllib --address auto --num-envs 400 --out runs/rllib
    ms-slam train rllib scaling --runners 1 2 4 --out runs/rllib-scaling

RLlib's new API stack: environment runners in processes of their own, on whatever machines Ray has,
and one learner here. Environments, observations, network, normalisation and policy file are those
of ``ms-slam train ppo``, and so are validation, ``--resume`` and what is written. A runner that
dies is started again, the training goes on without it meanwhile.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from ms_slam_agents.environments import first_seed, make_env
from ms_slam_agents.network import Network, load_parameters
from ms_slam_agents.normalization import Normalization, moment_tensors, restore_moments
from ms_slam_agents.options import Problem
from ms_slam_agents.policy import CLIP, EPSILON
from ms_slam_agents.policy_file import PolicyFile, Tensors
from ms_slam_agents.sb3_state import optimizer_tensors, restore_adam
from ms_slam_agents.trainers import RllibArgs as Args
from ms_slam_agents.trainers import rllib as main
from ms_slam_agents.training_run import TrainingRun, read_init, train_run
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.tune.registry import register_env
from scipy.signal import lfilter
from torch import Tensor

from ms_slam_env.errors import InputError

MODULE = "default_policy"  # RLlib's name for the only one
_ENV = "ms_slam_env"
_MOMENTS = ("mean", "var", "count")


# -- Environment and network -------------------------------------------------------------------


class Masked(gym.Wrapper[Any, Any, Any, Any]):
    """Shows the action mask beside the observation, where RLlib's modules can see it.

    Args:
        env: environment.
        runner: number of the runner that it is in; RLlib's seeds of one runner are the next one's
            too.
    """

    def __init__(self, env: gym.Env[Any, Any], runner: int = 0) -> None:
        super().__init__(env)
        self.runner = runner
        count = int(env.action_space.n)  # type: ignore[attr-defined]
        masks = gym.spaces.MultiBinary(count)
        self.observation_space = gym.spaces.Dict(
            {"action_mask": masks, "observations": env.observation_space}
        )

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """See Gymnasium."""
        if options.get("seed") is not None:
            options["seed"] = first_seed(options["seed"], self.runner)
        observation, _ = self.env.reset(**options)
        return self._beside(observation), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See Gymnasium; no ``info``, which would go to the learner with all the rest."""
        observation, *rest, _ = self.env.step(action)
        return self._beside(observation), *rest, {}  # type: ignore[return-value]

    def _beside(self, observation: Any) -> dict[str, Any]:
        mask = self.env.get_wrapper_attr("action_masks")()
        return {"action_mask": mask.astype(np.int8), "observations": observation}


class MaskedModule(TorchRLModule, ValueFunctionAPI):
    """Our network, with the moments that normalise what it sees as buffers.

    They go to the runners with the weights, and the learner alone changes them.
    """

    def setup(self) -> None:
        """Build it; called by RLlib."""
        given: Any = self.model_config
        self.network = Network(
            *(given[name] for name in ("inputs", "hidden", "actions")),
            candidates=given["candidates"],
            image=given["image"],
        )
        fresh = self.fresh_normalization()
        for name, value in moment_tensors(fresh).items():
            self.register_buffer(name.replace(".", "_"), torch.as_tensor(value))

    def fresh_normalization(self) -> Normalization:
        """One that has seen nothing."""
        given: Any = self.model_config
        return Normalization(*(given[k] for k in ("inputs", "actions", "candidates", "gamma")))

    @property
    def normalization(self) -> Normalization:
        """As the buffers have it."""
        made = self.fresh_normalization()
        for name, rms in (("observation", made.obs_rms), ("return", made.ret_rms)):
            mean, var, count = (getattr(self, f"{name}_{part}").numpy() for part in _MOMENTS)
            rms.mean, rms.var, rms.count = mean.copy(), var.copy(), float(count)
        return made

    @normalization.setter
    def normalization(self, made: Normalization) -> None:
        for name, value in moment_tensors(made).items():
            getattr(self, name.replace(".", "_")).copy_(torch.as_tensor(value))

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Tensor]:
        """Log-probabilities of the actions; values go along, since they cost the learner least."""
        log_probs, values = self._run(batch)
        return {Columns.ACTION_DIST_INPUTS: log_probs, Columns.EMBEDDINGS: values}

    def compute_values(self, batch: dict[str, Any], embeddings: Tensor | None = None) -> Tensor:
        """Values (B,)."""
        return self._run(batch)[1] if embeddings is None else embeddings

    def _run(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor]:
        seen, masks = (batch[Columns.OBS][name] for name in ("observations", "action_mask"))
        scaled = (seen - self.observation_mean) / torch.sqrt(self.observation_var + EPSILON)
        scaled = scaled.clamp(-CLIP, CLIP).float()
        return self.network(scaled, scaled[:, :0], masks.bool())


class Normalize(ConnectorV2):
    """Learns the moments from what the runners bring, and scales the rewards by them.

    Stands in the learner, behind RLlib's piece that adds a step to every episode to take the value
    there: it is no experience. The discounted sums of rewards, whose spread is the scale, begin
    anew with each piece of an episode.
    """

    def __call__(
        self, *, rl_module: Any, batch: Any, episodes: Sequence[Any], **_: Any
    ) -> dict[str, Any]:
        """See RLlib."""
        module: MaskedModule = rl_module[MODULE].unwrapped()
        normalization = module.normalization
        met: Any = list(episodes)
        pieces = list(self.single_agent_episode_iterator(met, agents_that_stepped_only=False))
        for episode in pieces:
            steps = slice(0, len(episode) - 1)
            normalization.obs_rms.update(episode.get_observations(steps)["observations"])
            rewards = np.asarray(episode.get_rewards(steps), np.float64)
            normalization.ret_rms.update(lfilter([1.0], [1.0, -normalization.gamma], rewards))
        for episode in pieces:
            scaled = np.asarray(episode.get_rewards()) / normalization.return_scale
            episode.set_rewards(new_data=np.clip(scaled, -CLIP, CLIP))
        module.normalization = normalization
        return batch


def make_config(args: Args, space: gym.Space[Any], actions: int, done: int) -> PPOConfig:
    """RLlib's options, of a run that has made ``done`` steps."""
    assert space.shape
    left = max(1, args.total_timesteps - done)
    rate = args.learning_rate * left / args.total_timesteps
    given = {
        "inputs": space.shape[0],
        "actions": actions,
        "hidden": args.hidden,
        "candidates": args.candidates,
        "image": args.image,
        "gamma": args.gamma,
    }
    config = PPOConfig()
    config.environment(_ENV)
    config.env_runners(
        num_env_runners=args.num_envs,
        num_envs_per_env_runner=args.envs_per_runner,
        rollout_fragment_length=args.n_steps,
        sample_timeout_s=None,  # a step takes as long as it takes
    )
    config.fault_tolerance(restart_failed_env_runners=True, ignore_env_runner_failures=False)
    config.learners(num_learners=0, learner_connector=lambda *_: Normalize())
    config.rl_module(rl_module_spec=RLModuleSpec(module_class=MaskedModule, model_config=given))
    config.training(
        train_batch_size_per_learner=args.round_steps,
        minibatch_size=args.batch_size,
        num_epochs=args.n_epochs,
        lr=[[0, rate], [left, 0.0]],
        gamma=args.gamma,
        lambda_=args.gae_lambda,
        entropy_coeff=args.ent_coef,
        clip_param=args.clip_range,
        vf_clip_param=float("inf"),
        vf_loss_coeff=args.value_weight,
        use_kl_loss=False,
        kl_coeff=0.0,
        grad_clip=0.5,
        grad_clip_by="global_norm",
    )
    config.debugging(seed=first_seed(args.seed, done), log_level="ERROR")
    return config


# -- Run ---------------------------------------------------------------------------------------


class Run(TrainingRun):
    """A training run on Ray, which must have been started.

    Args:
        args: of the training.
        file: policy file to resume from, if any.

    Raises:
        InputError: a policy to begin with that is of another network.
    """

    (algorithm,) = Args.algorithms

    def __init__(self, args: Args, file: PolicyFile | None) -> None:
        env = make_env(args, "train")
        env.close()
        super().__init__(args, env.observation_space, env.action_space, file)
        begun = file or (read_init(args).untrained() if args.init else None)
        register_env(_ENV, lambda context: make_masked(args, context.worker_index))
        config = make_config(args, env.observation_space, self.actions, self.steps)
        self.ppo: Any = config.build_algo()
        if begun:
            self._on_learner(lambda learner: restore_learner(learner, begun))
            self._sync()

    def _on_learner(self, act: Callable[[Any], Any]) -> Any:
        (result,) = self.ppo.learner_group.foreach_learner(act)
        return result.get()

    def _sync(self) -> None:
        """Send the learner's weights and moments to the runners."""
        self.ppo.env_runner_group.sync_weights(
            from_worker_or_learner_group=self.ppo.learner_group, inference_only=True
        )

    def enter_stage(self, stage: int) -> None:
        """See the base class; a runner that was started again hears of it too."""

        def enter(runner: Any) -> None:
            for env in runner.env.unwrapped.envs if runner.env else ():
                env.get_wrapper_attr("enter_stage")(stage)

        self.ppo.env_runner_group.foreach_env_runner(enter)

    def advance(self, stop: Callable[[], bool]) -> dict[str, float] | None:
        """Run one round: the runners play, and the learner learns."""
        if stop():
            return None
        result = self.ppo.train()
        played = result.get("env_runners", {}).get("num_env_steps_sampled", 0)
        learnt = result.get("learners", {}).get(MODULE, {})
        self.steps += int(played)
        self.epochs += self.ppo.config.num_epochs if learnt else 0
        names = {"policy_loss": "policy_loss", "value_loss": "vf_loss", "entropy": "entropy"}
        names |= {"explained_variance": "vf_explained_var"}
        said = {name: float(learnt[key]) for name, key in names.items() if key in learnt}
        of_episodes = {"return": "episode_return_mean", "episode_length": "episode_len_mean"}
        met = result.get("env_runners", {})
        said |= {name: float(met[key]) for name, key in of_episodes.items() if key in met}
        healthy = self.ppo.env_runner_group.num_healthy_remote_workers()
        return said | {"runners": float(healthy)}

    def tensors(self) -> Tensors:
        """See the base class."""
        return self._on_learner(learner_tensors)

    def close(self) -> None:
        """End the runners."""
        self.ppo.stop()


def make_masked(args: Problem, runner: int) -> gym.Env[Any, Any]:
    """A training environment, in a runner."""
    torch.set_num_threads(1)
    return Masked(make_env(args, "train", environment=max(0, runner - 1)), runner)


def learner_tensors(learner: Any) -> Tensors:
    """Network, optimiser and moments of RLlib's learner, for a policy file."""
    module: MaskedModule = learner.module[MODULE].unwrapped()
    state = learner.get_optimizer(MODULE).state_dict()
    network, moments = module.network.tensors(), moment_tensors(module.normalization)
    return network | moments | optimizer_tensors(_names(module), state)


def restore_learner(learner: Any, file: PolicyFile) -> None:
    """Load the state of RLlib's learner from a policy file."""
    module: MaskedModule = learner.module[MODULE].unwrapped()
    normalization = module.fresh_normalization()
    expected = {n: tuple(p.shape) for n, p in module.network.named_parameters()}
    if {n: v.shape for n, v in file.part("policy").items()} != expected:
        raise InputError("the initial policy has a different network")
    load_parameters(module.network, file)
    restore_moments(normalization, file)
    module.normalization = normalization
    if file.can_resume:
        restore_adam(learner.get_optimizer(MODULE), file.part("optimizer"), _names(module))


def _names(module: MaskedModule) -> list[str]:
    return [name for name, _ in module.network.named_parameters()]


def start_ray(args: Args, stack: ExitStack) -> None:
    """Start Ray here, or join the cluster, unless this process has done so."""
    if ray.is_initialized():
        return
    local: Any = {} if args.address else {"num_cpus": args.num_envs + 1, "include_dashboard": False}
    try:
        ray.init(args.address or "local", log_to_driver=False, logging_level=logging.ERROR, **local)
    except Exception as error:  # Ray's own say no more than this
        raise RuntimeError(
            f"Ray cannot be started or joined: {str(error).splitlines()[0]}"
        ) from None
    stack.callback(ray.shutdown)


def make_run(args: Args, file: PolicyFile | None, stack: ExitStack) -> Run:
    """Make a run on the existing Ray cluster, or on a new one."""
    start_ray(args, stack)
    run = Run(args, file)
    stack.callback(run.close)
    return run


def train(args: Args) -> int:
    """Train as ``args`` say; return the exit code; see `train_run`."""
    return train_run(args, Run.algorithm, make_run)


if __name__ == "__main__":
    sys.exit(main())
