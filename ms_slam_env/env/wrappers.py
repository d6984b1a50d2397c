"""Wrappers of the environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.env.active_slam import ActiveSlamEnv
from ms_slam_env.errors import InputError
from ms_slam_env.sequences.perturbations import make_perturbation


class Perturbed(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Perturbs the frames that the sensor of an ``ActiveSlamEnv`` gives.

    SLAM and the agent both see the perturbed frames; the true poses, and what reward and info say
    of them, stay the truth. Wrap again to combine perturbations; those of one kind apply in the
    order in which they were put on. It takes effect at the next reset::

        env = Perturbed(gym.make("MSActiveSLAM-FreeCamera-v0"), "motion-blur", exposure_s=0.03)
        env = Perturbed(env, "moving-objects", kind="box", count=2)
    """

    def __init__(self, env: gymnasium.Env[Any, Any], name: str, **options: Any) -> None:
        """Put a perturbation on.

        Args:
            env: an ``ActiveSlamEnv``, wrapped or not.
            name: one of ``ms_slam_env.sequences.PERTURBATIONS``, but for ``fast-motion``.
            **options: of the perturbation; by default its own strength.

        Raises:
            InputError: unknown name or option, a value out of range, or no ``ActiveSlamEnv``.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(self, name=name, **options)
        super().__init__(env)
        inner = env.unwrapped
        if not isinstance(inner, ActiveSlamEnv):
            raise InputError(f"Perturbed wraps an ActiveSlamEnv, not {type(inner).__name__}")
        inner.perturb(make_perturbation(name, options))

    def action_masks(self) -> NDArray[np.bool_]:
        """(n,) which actions are possible now; the name is sb3-contrib's."""
        return self.get_wrapper_attr("unwrapped").action_masks()
