"""Places a recorded camera motion in a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, make_pose, so3_exp
from ms_slam_env.scenes.scene import Scene

SCALES = tuple(round(1.0 - 0.05 * k, 2) for k in range(19))
"""Scales tried, from the largest to the smallest."""

_RADIUS_M = 0.15  # least clearance of the camera
_PLACES = 400  # positions tried per scale
_HEIGHTS = 8  # candidate heights, from start poses, for the middle of the motion
_FIRST_CHECKED = 40  # poses checked first, which rule out most positions


@dataclass(frozen=True)
class Placement:
    """A motion placed in a scene.

    Attributes:
        poses: (N, 4, 4) T_world_camera.
        scale: factor on the translations.
        T_scene_recording: (4, 4) pose of the recording's scaled world in the scene.
    """

    poses: Float64
    scale: float
    T_scene_recording: Float64


def upright(poses: Float64) -> Float64:
    """Rotation (3, 3) that turns the world axis nearest to the cameras' mean up into +z."""
    up = -poses[:, :3, 1].mean(axis=0)
    axis = int(np.abs(up).argmax())
    up_axis = np.zeros(3)
    up_axis[axis] = np.sign(up[axis])
    if axis == 2:
        return np.eye(3) if up_axis[2] > 0 else np.diag([1.0, -1.0, -1.0])
    x = np.cross(up_axis, [0.0, 0.0, 1.0])  # any right-handed frame with z up will do
    return np.stack([x, np.cross(up_axis, x), up_axis])


def place_trajectory(
    scene: Scene, poses: ArrayLike, seed: int = 0, scale: float | None = None
) -> Placement:
    """Turn a motion upright and place it in free space of a scene, as large as fits.

    Args:
        scene: the scene.
        poses: (N, 4, 4) T_world_camera; the world axis nearest to the cameras' up becomes z.
        seed: seed of the positions tried.
        scale: factor on the translations; by default the largest of ``SCALES`` that fits.

    Raises:
        InputError: no pose, a pose that is not a rigid motion, a scale that is not positive, or no
            position where the motion fits.
    """
    given = np.asarray(poses, dtype=np.float64)
    if given.ndim != 3 or len(given) == 0:
        raise InputError(f"a trajectory must have shape (N, 4, 4), got {given.shape}")
    for index, pose in enumerate(given):
        check_pose(pose, f"pose {index} of the trajectory")
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise InputError(f"scale = {scale} must be finite and above 0")
    R_up = upright(given)
    rng = np.random.default_rng([seed, 79])
    eyes = given[:, :3, 3] @ R_up.T
    centre = 0.5 * (eyes.min(axis=0) + eyes.max(axis=0))
    heights = [scene.sample_start(rng)[2, 3] for _ in range(_HEIGHTS)]
    for factor in SCALES if scale is None else (scale,):
        for _ in range(_PLACES):
            yaw = so3_exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
            place = _place(scene, heights, rng)
            moved = factor * (eyes - centre) @ yaw.T + place
            if not _is_free(scene, moved):
                continue
            R = yaw @ R_up
            result = np.repeat(np.eye(4)[None], len(given), axis=0)
            result[:, :3, :3] = R @ given[:, :3, :3]
            result[:, :3, 3] = moved
            return Placement(result, factor, make_pose(R, place - factor * yaw @ centre))
    raise InputError(
        f"the trajectory fits nowhere into scene {scene.name!r}, seed {scene.seed}, "
        + ("at any scale" if scale is None else f"at scale {scale:g}")
    )


def _place(scene: Scene, heights: list[float], rng: np.random.Generator) -> Float64:
    """A point (3,) within the scene's bounds at about one of the heights."""
    low, high = scene.bounds()
    point = rng.uniform(low, high)
    point[2] = rng.choice(heights) + rng.uniform(-0.2, 0.2)
    return point


def _is_free(scene: Scene, eyes: Float64) -> bool:
    few = eyes[:: max(1, len(eyes) // _FIRST_CHECKED)]
    return bool(
        (scene.clearance(few) > _RADIUS_M).all() and (scene.clearance(eyes) > _RADIUS_M).all()
    )
