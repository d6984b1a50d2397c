"""Checks of what a batch of SLAMs is given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.slam.base import Float64


def check_images(
    color: NDArray[np.uint8], depth: NDArray[np.float32], batch: int, intrinsics: Intrinsics
) -> None:
    """Refuse another batch or image size than (B, H, W), and depth that is no depth."""
    size = (batch, *intrinsics.shape)
    if color.shape != (*size, 3) or depth.shape != size:
        raise InputError(
            f"colour {color.shape} and depth {depth.shape} must be {(*size, 3)} and {size}"
        )
    if not (depth.min() >= 0 and depth.max() < np.inf):
        raise InputError("depth holds NaN, infinite or negative values; 0 means no reading")


def check_poses(poses: Float64, batch: int) -> Float64:
    """Poses (B, 4, 4); refuse what is none."""
    if np.ndim(poses) != 3 or len(poses) != batch:
        raise InputError(f"T_world_camera must have shape {(batch, 4, 4)}, got {np.shape(poses)}")
    return np.stack([check_pose(pose, "T_world_camera") for pose in poses])


def check_guesses(guesses: Sequence[ArrayLike | None] | None, batch: int) -> Float64 | None:
    """Guesses (B, 4, 4), NaN where an env has none; None if none has. Refuse what is no pose."""
    if guesses is None:
        return None
    if len(guesses) != batch:
        raise InputError(
            f"T_world_camera_guess must hold {batch} poses or None, got {len(guesses)}"
        )
    if all(guess is None for guess in guesses):
        return None
    none = np.full((4, 4), np.nan)
    return np.stack(
        [none if guess is None else check_pose(guess, "T_world_camera_guess") for guess in guesses]
    )
