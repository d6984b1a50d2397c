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
"""The environments with a camera as good as the sensor."""

_PERTURBATIONS = (
    "rolling-shutter",
    "motion-blur",
    "misregistration",
    "exposure-ramp",
    "exposure-jumps",
    "auto-exposure",
    "black-frames",
    "depth-dropout",
    "depth-quantisation",
    "frame-skipping",
    "moving-objects",
    "illumination",
)


def _perturbed_ids() -> dict[str, tuple[str, str]]:
    """Id to embodiment and perturbation."""
    ids = {}
    for perturbation in _PERTURBATIONS:
        title = "".join(word.capitalize() for word in perturbation.split("-"))
        ids[f"MSActiveSLAM-{title}-v0"] = ("arm", perturbation)
        ids[f"MSActiveSLAM-FreeCamera-{title}-v0"] = ("free", perturbation)
    ids["MSActiveSLAM-FreeCamera-FastMotion-v0"] = ("free", "fast-motion")
    return ids


_PERTURBED = _perturbed_ids()

PERTURBED_ENV_IDS = tuple(_PERTURBED)
"""The same with one imperfection; ``perturbation={...}`` of ``gym.make`` sets its strength."""


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


class PerturbedInProcessVectorEnv(InProcessVectorEnv):
    """The same for environments with an imperfect camera."""

    def _make_one(self, **options: Any) -> gymnasium.Env[Any, Any]:
        return make_perturbed_env(**options)


def make_env(**options: Any) -> gymnasium.Env[Any, Any]:
    """Entry point: one environment."""
    from ms_slam_env.env.active_slam import ActiveSlamEnv

    return ActiveSlamEnv(**options)


def make_adaptive_env(**options: Any) -> gymnasium.Env[Any, Any]:
    """Entry point: one environment whose agent chooses the SLAM configuration too."""
    from ms_slam_env.env.adaptive_env import AdaptiveSlamEnv

    return AdaptiveSlamEnv(**options)


def make_perturbed_env(**options: Any) -> gymnasium.Env[Any, Any]:
    """Entry point: one environment with an imperfect camera."""
    from ms_slam_env.env.wrappers.make import make_perturbed

    return make_perturbed(**options)


# Without "human" Gymnasium would warn, wrap the environment and fail at the first reset for want of
# pygame; with it the environment itself is asked, and refuses in one line.
make_env.metadata = {"render_modes": ["rgb_array", "human"]}  # type: ignore[attr-defined]
make_adaptive_env.metadata = make_env.metadata  # type: ignore[attr-defined]
make_perturbed_env.metadata = make_env.metadata  # type: ignore[attr-defined]


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
    for env_id, (embodiment, perturbation) in _PERTURBED.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="ms_slam_env.registration:make_perturbed_env",
                vector_entry_point="ms_slam_env.registration:PerturbedInProcessVectorEnv",
                max_episode_steps=MAX_EPISODE_STEPS,
                kwargs={"embodiment": embodiment, "perturbed_by": perturbation},
            )
