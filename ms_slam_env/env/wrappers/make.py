"""Builds the environments whose ids name a perturbation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from ms_slam_env.env.active_slam import ActiveSlamEnv
from ms_slam_env.env.config import EnvConfig
from ms_slam_env.env.wrappers.perturbed import Perturbed
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.sequences.perturbations import FastMotion

_HURRY = 2.0


def make_perturbed(
    perturbed_by: str, perturbation: Mapping[str, Any] | None = None, **options: Any
) -> gymnasium.Env[Any, Any]:
    """Build an environment with one perturbation.

    ``fast-motion`` makes every motion of a free camera ``factor`` (2) times as large in the same
    time; everything else wraps the environment in ``Perturbed``.

    Args:
        perturbed_by: name of the perturbation.
        perturbation: its options.
        **options: of the environment.

    Raises:
        InputError: an unknown option, or a value out of range.
    """
    strength = dict(perturbation or {})
    if perturbed_by != "fast-motion":
        return Perturbed(ActiveSlamEnv(**options), perturbed_by, **strength)
    for name in strength:
        if name != "factor":
            raise unknown("option of fast-motion in an environment", name, ("factor",))
    if options.get("embodiment") not in ("free", "fixed-translation"):
        raise InputError("fast-motion needs a free camera: an arm moves as fast as its joints")
    factor = FastMotion(factor=strength.get("factor", _HURRY)).factor
    for name in ("step_m", "step_rad"):
        options[name] = factor * options.get(name, getattr(EnvConfig, name))
    return ActiveSlamEnv(**options)
