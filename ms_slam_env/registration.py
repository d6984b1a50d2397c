"""The ids of the environments; registering costs no import of the environment itself."""

from __future__ import annotations

from typing import Any

import gymnasium

MAX_EPISODE_STEPS = 150

ADAPTIVE_ID = "MSActiveSLAM-Adaptive-v0"
"""The agent chooses motion and SLAM configuration, by an arm unless ``embodiment`` is given."""

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
    """Arguments by id."""
    found = {}
    for perturbation in _PERTURBATIONS:
        title = "".join(word.capitalize() for word in perturbation.split("-"))
        for embodiment, prefix in (("arm", ""), ("free", "FreeCamera-")):
            arguments = {"embodiment": embodiment, "perturbed_by": perturbation}
            found[f"MSActiveSLAM-{prefix}{title}-v0"] = arguments
    fast = {"embodiment": "free", "perturbed_by": "fast-motion"}
    return {**found, "MSActiveSLAM-FreeCamera-FastMotion-v0": fast}


_ARGUMENTS = {**_PLAIN, **_perturbed()}

ENV_IDS = tuple(_PLAIN)
"""The environments with a camera as good as the sensor."""

PERTURBED_ENV_IDS = tuple(name for name in _ARGUMENTS if name not in _PLAIN)
"""The same with one imperfection; ``perturbation={...}`` of ``gym.make`` sets its strength."""


def register_all() -> None:
    """Register the ids with Gymnasium; a second call changes nothing."""
    for env_id, arguments in _ARGUMENTS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="ms_slam_env.env.make:make_env",
                vector_entry_point="ms_slam_env.env.make:InProcessVectorEnv",
                max_episode_steps=MAX_EPISODE_STEPS,
                kwargs=arguments,
            )
