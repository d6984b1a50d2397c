"""Poses to go to, and how many motions away they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

_PITCH_RAD = 0.7


def distance_in_steps(poses: Float64, goal: Float64, step_m: float, step_rad: float) -> Float64:
    """Translations and rotations (N, 2) of one motion each, from ``poses`` (N, 4, 4) to a goal."""
    metres = np.linalg.norm(poses[:, :3, 3] - goal[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], goal[:3, :3]) - 1) / 2
    return np.stack([metres / step_m, np.arccos(np.clip(cosine, -1, 1)) / step_rad], axis=1)


def draw_goals(rng: np.random.Generator, here: Float64, free: Float64, number: int) -> Float64:
    """Upright poses (N, 4, 4) looking anywhere but straight up or down.

    ``number`` at positions drawn from ``free`` (M, 3), a third as many where the camera is.
    """
    away = free[rng.integers(len(free), size=number)] if len(free) else np.zeros((0, 3))
    positions = np.concatenate([np.repeat(here[None, :3, 3], number // 3, axis=0), away])
    yaw = rng.uniform(-np.pi, np.pi, len(positions))
    pitch = rng.uniform(-_PITCH_RAD, _PITCH_RAD, len(positions))
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1
    )
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=1)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = positions
    return poses
