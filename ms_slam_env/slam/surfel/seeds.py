"""Starting poses that tracking and relocalisation try, relative to the model view's pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.geometry import make_pose, so3_exp

Float64 = NDArray[np.float64]

NUM_SEEDS = 8
PAN_RAD = np.radians(8.0)
ROLL_RAD = np.radians(8.0)


def _rotation(axis: int, angle: float) -> Float64:
    twist = np.zeros(3)
    twist[axis] = angle
    return make_pose(so3_exp(twist), np.zeros(3))


_TURNS = np.stack(
    [
        *(_rotation(1, sign * PAN_RAD) for sign in (1, -1)),
        *(_rotation(0, sign * PAN_RAD) for sign in (1, -1)),
        *(_rotation(2, sign * ROLL_RAD) for sign in (1, -1)),
    ]
)


def tracking_seeds(last_motion: Float64) -> Float64:
    """Starts T_model_live (NUM_SEEDS, 4, 4): at rest, at constant velocity, turned six ways.

    A turn stands for a sideways step too: both shift the image.
    """
    return np.concatenate([np.eye(4)[None], last_motion[None], _TURNS])


def relocalisation_seeds(attempt: int) -> Float64:
    """Starts (NUM_SEEDS, 4, 4) of one attempt; successive attempts search wider and wider.

    Each holds the pose of the model view and turns with steps drawn from a fixed sequence, the
    same in every run.
    """
    rng = np.random.default_rng(attempt)
    reach = min(1.0, 0.4 + 0.05 * attempt)
    seeds = [np.eye(4)]
    for _ in range(NUM_SEEDS - 1):
        turn = rng.uniform(-1, 1, 3) * np.radians([25.0, 35.0, 15.0]) * reach
        step = rng.uniform(-1, 1, 3) * 0.25 * reach
        seeds.append(make_pose(so3_exp(turn), step))
    return np.stack(seeds)
