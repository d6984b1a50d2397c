"""The paper's decomposition of the space around the camera: 7 translations x 7 rotations.

Saeedi et al., ICRA 2017, section V-D and Algorithm 1, line 2. Axes are those of the current
camera frame: x right, y down, z forward.
"""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import make_pose, so3_exp

TRANSLATIONS = ("none", "up", "down", "left", "right", "forward", "backward")
ROTATIONS = (
    "none",
    "roll right",
    "roll left",
    "pitch forward",
    "pitch backward",
    "yaw anticlockwise",
    "yaw clockwise",
)
NUM_TRANSLATIONS = len(TRANSLATIONS)
NUM_ROTATIONS = len(ROTATIONS)
NUM_MOTIONS = NUM_TRANSLATIONS * NUM_ROTATIONS

TRANSLATION_DIRECTIONS: Float64 = np.array(
    [[0, 0, 0], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, -1]],
    dtype=np.float64,
)
# Right-handed about x right, y down, z forward: +z turns x towards y, so the horizon falls to the
# left and the camera's right side goes down (roll right); +x turns y towards z, so the view goes
# up (pitch backward); +y turns z towards x, so the view goes right (yaw clockwise from above).
ROTATION_AXES: Float64 = np.array(
    [[0, 0, 0], [0, 0, 1], [0, 0, -1], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]],
    dtype=np.float64,
)


def decompose(step_m: float, step_rad: float) -> Float64:
    """The 49 motions ``T_camera_next`` (49, 4, 4); motion ``7 * translation + rotation``.

    Each is one rigid motion [R | t]: R the rotation by ``step_rad``, t the translation by
    ``step_m`` along an axis of the current camera frame.

    Raises:
        InputError: a step that is negative or not finite.
    """
    if not (np.isfinite(step_m) and np.isfinite(step_rad) and min(step_m, step_rad) >= 0):
        raise InputError(f"steps must be finite and >= 0, got {step_m} m and {step_rad} rad")
    rotations = [so3_exp(axis * step_rad) for axis in ROTATION_AXES]
    return np.stack(
        [
            make_pose(R, direction * step_m)
            for direction in TRANSLATION_DIRECTIONS
            for R in rotations
        ]
    )


def shares_of(twist: Float64) -> Float64:
    """The share (14,) of each translation and rotation in a twist (6,) within [-1, 1].

    Of one of the 49 motions, the motion one-hot. The share of "none" is what the largest leaves.
    """
    moved = np.maximum(TRANSLATION_DIRECTIONS @ twist[:3], 0)
    turned = np.maximum(ROTATION_AXES @ twist[3:], 0)
    moved[0], turned[0] = 1 - moved.max(), 1 - turned.max()
    return np.concatenate([moved, turned])


def describe(action: int | Float64) -> str:
    """Words for one of the 49 motions, such as ``"forward, yaw clockwise"``, or for a twist."""
    if isinstance(action, np.ndarray):
        named = zip((*TRANSLATIONS, *ROTATIONS), shares_of(action), strict=True)
        words = [f"{share:.2f} {name}" for name, share in named if share and name != "none"]
        return ", ".join(words) or "none"
    translation, rotation = divmod(int(action), NUM_ROTATIONS)
    return f"{TRANSLATIONS[translation]}, {ROTATIONS[rotation]}"
