"""Poses to search from where the last one leads nowhere."""

from __future__ import annotations

import numpy as np

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import make_pose, orthonormal, so3_exp
from ms_slam_env.slam.shared.alignment_measures import DepthImage, overlay
from ms_slam_env.slam.slam_backend import Float64

TURN_RAD = np.radians(10.0)
STEP_M = 0.1
_TRIALS = 6  # motions that are tried, of all that are compared
_SAMPLES = 600  # readings that a motion is judged by


def _signed_axes(size: float) -> Float64:
    """Vectors (7, 3): none, and both ways along each axis."""
    return size * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


MOTIONS = np.stack(
    [
        make_pose(so3_exp(turn), step)
        for turn in _signed_axes(float(TURN_RAD))
        for step in _signed_axes(STEP_M)
    ]
)
"""Motions (49, 4, 4): no turn or one of 10 degrees, with no step or one of 10 cm."""


def motion_hypotheses(
    frame: DepthImage, reference: DepthImage, T_last_camera: Float64, intrinsics: Intrinsics
) -> Float64:
    """Motions T_reference_frame (7, 4, 4) to search from, in the order of trial.

    First the last motion ``T_last_camera`` (4, 4), should it go on; then the best of ``MOTIONS``,
    judged by how well they lay the frame over the reference, in depth and intensity.
    """
    # What goes on from frame to frame is made rigid: pose times last motion, frame after frame,
    # multiplies rounding errors of the rotation by 2.4 each time.
    scores = overlay(frame, reference, MOTIONS, intrinsics, _SAMPLES).scores
    best = np.argsort(-scores, kind="stable")[:_TRIALS]
    return np.concatenate([orthonormal(T_last_camera)[None], MOTIONS[best]])
