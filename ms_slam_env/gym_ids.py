"""Gymnasium ids of the environments; registering does not import the environment itself."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec

from ms_slam_env.tasks import OWN, env_id_of

MAX_EPISODE_STEPS = 150

FOLLOWS_STATES = WrapperSpec("FollowStates", "ms_slam_env.env.wrappers:FollowStates", {})
"""Outermost wrapper of every id: keeps Gymnasium's own wrappers in step with a loaded state."""

ADAPTIVE_ID = "MSActiveSLAM-Adaptive-v0"
"""The agent chooses motion and SLAM configuration; an arm unless ``embodiment`` is given."""

_PLAIN: dict[str, dict[str, Any]] = {
    "MSActiveSLAM-v0": {"embodiment": "arm"},
    "MSActiveSLAM-FreeCamera-v0": {"embodiment": "free"},
    "MSActiveSLAM-FixedTranslation-v0": {"embodiment": "fixed-translation"},
    ADAPTIVE_ID: {"embodiment": "arm", "agent_configures_slam": True},
}

_PERTURBATIONS = (
    "rolling-shutter",
    "motion-blur",
    "misregistration",
    "lens-distortion",
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


def _perturbed() -> dict[str, dict[str, Any]]:
    """Environment arguments by id."""
    found = {}
    for perturbation in _PERTURBATIONS:
        title = "".join(word.capitalize() for word in perturbation.split("-"))
        for embodiment, prefix in (("arm", ""), ("free", "FreeCamera-")):
            arguments = {"embodiment": embodiment, "perturbed_by": perturbation}
            found[f"MSActiveSLAM-{prefix}{title}-v0"] = arguments
    fast = {"embodiment": "free", "perturbed_by": "fast-motion"}
    return {**found, "MSActiveSLAM-FreeCamera-FastMotion-v0": fast}


_ARGUMENTS = {**_PLAIN, **_perturbed()}
_TASKS = {env_id_of(name): (name, make()) for name, make in OWN.items()}

ENV_IDS = tuple(_PLAIN)
"""The environments without perturbations."""

PERTURBED_ENV_IDS = tuple(name for name in _ARGUMENTS if name not in _PLAIN)
"""The perturbed environments; ``gym.make(..., perturbation={...})`` sets the strength."""

TASK_IDS = tuple(_TASKS)
"""The benchmark tasks, each with its scenes, options and episode length."""


CONTINUOUS_IDS = tuple(
    name.replace("-v0", "-Continuous-v0")
    for name in ("MSActiveSLAM-v0", "MSActiveSLAM-FreeCamera-v0", *TASK_IDS)
)
"""Those whose actions are points of a box: ``actions="continuous"``."""

BATCHED_IDS = tuple(f"batched/{name}" for name in ("MSActiveSLAM-FreeCamera-v0", env_id_of("room")))
"""Those that ``gym.make_vec`` also steps all at once.

In a namespace of their own: Gymnasium refuses a vector entry point beside the wrapper that follows
states, and would make it the default of ``make_vec``.
"""


def register_all() -> None:
    """Register the ids with Gymnasium; a second call changes nothing."""
    for env_id, arguments in _ARGUMENTS.items():
        _register(env_id, MAX_EPISODE_STEPS, arguments)
    for env_id, (name, task) in _TASKS.items():
        _register(env_id, task.steps, {**_ARGUMENTS[task.env_id], "task": name})
    for env_id in CONTINUOUS_IDS:
        discrete = gymnasium.spec(env_id.replace("-Continuous", ""))
        steps = discrete.max_episode_steps or MAX_EPISODE_STEPS
        _register(env_id, steps, {**discrete.kwargs, "actions": "continuous"})
    for batched_id in BATCHED_IDS:
        if batched_id not in gymnasium.registry:
            single = gymnasium.spec(batched_id.removeprefix("batched/"))
            gymnasium.register(
                batched_id,
                entry_point="ms_slam_env.env.batched.make:refuse_single",
                vector_entry_point="ms_slam_env.env.batched.make:make_batched",
                max_episode_steps=single.max_episode_steps,
                kwargs=single.kwargs,
            )


def _register(env_id: str, steps: int, arguments: dict[str, Any]) -> None:
    if env_id not in gymnasium.registry:
        gymnasium.register(
            env_id,
            entry_point="ms_slam_env.env.make:make_env",
            max_episode_steps=steps,
            disable_env_checker=True,  # meant for authors of environments; demands a reset first
            additional_wrappers=(FOLLOWS_STATES,),
            kwargs=arguments,
        )
