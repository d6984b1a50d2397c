"""The ids of the environments; registering costs no import of the environment itself."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.vector import SyncVectorEnv

MAX_EPISODE_STEPS = 150

_EMBODIMENT_OF_ID = {
    "MSActiveSLAM-v0": "arm",
    "MSActiveSLAM-FreeCamera-v0": "free",
    "MSActiveSLAM-FixedTranslation-v0": "fixed-translation",
}

ENV_IDS = tuple(_EMBODIMENT_OF_ID)
"""Every registered environment id."""


class InProcessVectorEnv(SyncVectorEnv):
    """Vector entry point: ``num_envs`` time-limited environments stepped in this process."""

    def __init__(
        self, num_envs: int, max_episode_steps: int = MAX_EPISODE_STEPS, **options: Any
    ) -> None:
        def make() -> gymnasium.Env[Any, Any]:
            from ms_slam_env.env.active_slam import ActiveSlamEnv

            return gymnasium.wrappers.TimeLimit(ActiveSlamEnv(**options), max_episode_steps)

        super().__init__([make] * num_envs)


def make_env(**options: Any) -> gymnasium.Env[Any, Any]:
    """Entry point: one environment."""
    from ms_slam_env.env.active_slam import ActiveSlamEnv

    return ActiveSlamEnv(**options)


# Without "human" Gymnasium would warn, wrap the environment and fail at the first reset for want of
# pygame; with it the environment itself is asked, and refuses in one line.
make_env.metadata = {"render_modes": ["rgb_array", "human"]}  # type: ignore[attr-defined]


def register_all() -> None:
    """Register the ids with Gymnasium; a second call changes nothing."""
    for env_id, embodiment in _EMBODIMENT_OF_ID.items():
        if env_id in gymnasium.registry:
            continue
        gymnasium.register(
            env_id,
            entry_point="ms_slam_env.registration:make_env",
            vector_entry_point="ms_slam_env.registration:InProcessVectorEnv",
            max_episode_steps=MAX_EPISODE_STEPS,
            kwargs={"embodiment": embodiment},
        )
