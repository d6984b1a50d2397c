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

ADAPTIVE_ID = "MSActiveSLAM-Adaptive-v0"
"""The agent chooses motion and SLAM configuration, by an arm unless ``embodiment`` is given."""

ENV_IDS = (*_EMBODIMENT_OF_ID, ADAPTIVE_ID)
"""Every registered environment id."""


class InProcessVectorEnv(SyncVectorEnv):
    """Vector entry point: ``num_envs`` time-limited environments stepped in this process."""

    def __init__(
        self, num_envs: int, max_episode_steps: int = MAX_EPISODE_STEPS, **options: Any
    ) -> None:
        def make() -> gymnasium.Env[Any, Any]:
            return gymnasium.wrappers.TimeLimit(self._make_one(**options), max_episode_steps)

        super().__init__([make] * num_envs)

    def _make_one(self, **options: Any) -> gymnasium.Env[Any, Any]:
        return make_env(**options)


class AdaptiveInProcessVectorEnv(InProcessVectorEnv):
    """The same for environments whose agent chooses the SLAM configuration too."""

    def _make_one(self, **options: Any) -> gymnasium.Env[Any, Any]:
        return make_adaptive_env(**options)


def make_env(**options: Any) -> gymnasium.Env[Any, Any]:
    """Entry point: one environment."""
    from ms_slam_env.env.active_slam import ActiveSlamEnv

    return ActiveSlamEnv(**options)


def make_adaptive_env(**options: Any) -> gymnasium.Env[Any, Any]:
    """Entry point: one environment whose agent chooses the SLAM configuration too."""
    from ms_slam_env.env.adaptive_env import AdaptiveSlamEnv

    return AdaptiveSlamEnv(**options)


# Without "human" Gymnasium would warn, wrap the environment and fail at the first reset for want of
# pygame; with it the environment itself is asked, and refuses in one line.
make_env.metadata = {"render_modes": ["rgb_array", "human"]}  # type: ignore[attr-defined]
make_adaptive_env.metadata = make_env.metadata  # type: ignore[attr-defined]


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
    if ADAPTIVE_ID not in gymnasium.registry:
        gymnasium.register(
            ADAPTIVE_ID,
            entry_point="ms_slam_env.registration:make_adaptive_env",
            vector_entry_point="ms_slam_env.registration:AdaptiveInProcessVectorEnv",
            max_episode_steps=MAX_EPISODE_STEPS,
            kwargs={"embodiment": "arm"},
        )
