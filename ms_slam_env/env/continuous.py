"""Continuous actions: a point of a box, scaled to a motion of the camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env.env.actions import ActionDecoder, as_array
from ms_slam_env.errors import InputError
from ms_slam_env.robot import NUM_MOTIONS, NUM_ROTATIONS
from ms_slam_env.robot.action_primitives import ROTATION_AXES, TRANSLATION_DIRECTIONS


def point_of(action: int) -> Float64:
    """The point (6,) of the box that is one of the 49 motions."""
    translation, rotation = divmod(int(action), NUM_ROTATIONS)
    return np.concatenate([TRANSLATION_DIRECTIONS[translation], ROTATION_AXES[rotation]])


class ContinuousActions(ActionDecoder):
    """``Box(-1, 1, (6,))``: translation and rotation vector, in units of a step.

    Along and about the axes of the camera frame: x right, y down, z forward. The 49 motions are
    points of the box (`point_of`).

    Args:
        num_motions: of the embodiment.
        agent_configures_slam: whether an action has a second part.

    Raises:
        InputError: an embodiment with a fixed translation, or an action of two parts.
    """

    def __init__(self, num_motions: int, agent_configures_slam: bool) -> None:
        if agent_configures_slam:
            raise InputError(
                "actions='continuous' is not possible where the agent also chooses the SLAM "
                "configuration; valid choices: discrete"
            )
        if num_motions != NUM_MOTIONS:
            raise InputError(
                "actions='continuous' needs an embodiment that chooses its translation; valid "
                "choices: free, arm, arm-kinematic"
            )
        self.space = spaces.Box(-1, 1, (6,), np.float32)

    def decode(self, action: Any) -> Float64:
        """The action (6,); see the base class."""
        array = as_array(action)
        is_number = array.shape == (6,) and array.dtype.kind in "iuf"
        if not is_number or not (np.abs(array) <= 1).all():
            shown = " ".join(repr(action).split())
            raise InputError(f"action {shown[:100]} is not six finite numbers in [-1, 1]")
        return array.astype(np.float64)

    def masks(self, motion_masks: Bool) -> Bool:
        """Refuse: there is no mask."""
        raise InputError(
            "continuous actions have no mask: a motion that is blocked stops short, and "
            "info['travelled'] says where; actions='discrete' has masks"
        )
