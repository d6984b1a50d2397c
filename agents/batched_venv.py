"""A batch of environments that is stepped at once, as Stable-Baselines3 and our PPO expect it."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from ms_slam_env.errors import InputError


class BatchedVecEnv(VecEnv):
    """A Gymnasium vector environment whose episodes restart in the step that ends them.

    An environment's ``info`` has ``reward_terms`` and, where an episode ends,
    ``terminal_observation`` and ``TimeLimit.truncated``.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        """Wrap environments.

        Raises:
            InputError: they restart their episodes later, or not by themselves.
        """
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise InputError(f"autoreset_mode must be SameStep for Stable-Baselines3, not {mode}")
        self.envs = envs
        self._actions: Any = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """See the base class; seeds come from ``seed``."""
        given = [seed for seed in self._seeds if seed is not None]
        observations, _ = self.envs.reset(seed=given or None)  # type: ignore[arg-type]
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """See the base class."""
        self._actions = actions

    def step_wait(self) -> Any:
        """See the base class."""
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        ended = terminated | truncated
        last = info["final_info"] if ended.any() else info
        infos: list[dict[str, Any]] = []
        for env in range(self.num_envs):
            own = last if ended[env] else info
            terms = own["reward_terms"].items()
            named = {name: float(of[env]) for name, of in terms if name[0] != "_"}
            infos.append({"reward_terms": named, "action_mask": own["action_mask"][env]})
            if ended[env]:
                infos[env]["terminal_observation"] = info["final_obs"][env]
                infos[env]["TimeLimit.truncated"] = bool(truncated[env] and not terminated[env])
        return observations, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        """See the base class."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """See the base class; `action_masks` is the mask itself."""
        values = self.envs.get_attr(attr_name)  # type: ignore[attr-defined]
        return [values[env] for env in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: the environments are one.

        Raises:
            InputError: always.
        """
        raise InputError(f"set_attr({attr_name!r}): the environments of a batch are one")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """See the base class; a batch has only `action_masks`."""
        values = self.envs.call(method_name, *method_args, **method_kwargs)  # type: ignore[attr-defined]
        return [values[env] for env in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """See the base class; none is."""
        return [False for _ in self._get_indices(indices)]
