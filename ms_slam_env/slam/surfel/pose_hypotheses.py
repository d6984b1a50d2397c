"""Pose hypotheses of tracking and relocalization: how they start, and which one is selected.

They are motions T_model_live, relative to the pose of the model view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose, make_pose, relative_angle, se3_exp, se3_log, so3_exp
from ms_slam_env.slam.surfel.normal_equations import OFF, RUNNING, Hypotheses, Sum

NUM_HYPOTHESES = 8
AT_REST, CONSTANT_VELOCITY, INITIAL_GUESS = (wp.constant(i) for i in range(3))
"""Indices of the first hypotheses; the guess, if any, is the last of them."""
CLEARLY_BETTER = wp.constant(wp.float64(0.97))  # ratios of scores
CLEARLY_WORSE = wp.constant(wp.float64(1.03))
DECAY = 0.9  # factor per frame for a motion that is only predicted
NUM_FIRST = 2  # tried first, with the guess if any: at rest and at constant velocity


def _turn(pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> Float64:
    return make_pose(so3_exp(np.radians([tilt_deg, pan_deg, roll_deg])), np.zeros(3))


_TURNS = np.stack(
    [_turn(*turn) for turn in ((8, 0), (-8, 0), (0, 8), (0, -8), (0, 0, 8), (0, 0, -8))]
)


def tracking_hypotheses(last_motion: Float64) -> Float64:
    """Starts T_model_live (..., NUM_HYPOTHESES, 4, 4) after motions (..., 4, 4).

    At rest, at constant velocity, turned six ways. A turn stands for a sideways step too: both
    shift the image.
    """
    starts = np.empty((*last_motion.shape[:-2], NUM_HYPOTHESES, 4, 4))
    starts[..., AT_REST, :, :], starts[..., CONSTANT_VELOCITY, :, :] = np.eye(4), last_motion
    starts[..., NUM_FIRST:, :, :] = _TURNS
    return starts


def relocalization_hypotheses(attempt: int) -> Float64:
    """Starts (NUM_HYPOTHESES, 4, 4) of one attempt; later attempts search more widely.

    They are the pose of the model view and random motions, drawn with ``attempt`` as the seed and
    so the same in every run.
    """
    rng = np.random.default_rng(attempt)
    reach = min(1.0, 0.4 + 0.05 * attempt)
    hypotheses = [np.eye(4)]
    for _ in range(NUM_HYPOTHESES - 1):
        turn = rng.uniform(-1, 1, 3) * np.radians([25.0, 35.0, 15.0]) * reach
        step = rng.uniform(-1, 1, 3) * 0.25 * reach
        hypotheses.append(make_pose(so3_exp(turn), step))
    return np.stack(hypotheses)


_HERE = np.eye(4)
_AXES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
_TURNS_DEG = (  # pan, tilt, roll
    [14 * np.array(axis) for axis in _AXES],
    [(12, 12, 0), (12, -12, 0), (-12, 12, 0), (-12, -12, 0), (25, 0, 0), (-25, 0, 0)],
    [22 * np.array(axis) for axis in _AXES],
)
KEYFRAME_HYPOTHESES = np.stack(
    [[_HERE, _HERE, *(_turn(*turn) for turn in turns)] for turns in _TURNS_DEG]
)
"""Starts (3, 8, 4, 4) relative to a keyframe, used in turn; a turn also covers a sideways step."""
UNMOVED = np.tile(_HERE, (NUM_HYPOTHESES, 1, 1))


def damped(motion: Float64) -> Float64:
    """A motion (4, 4) slowed by ``DECAY``."""
    return se3_exp(DECAY * se3_log(motion))


def motion_weight(motions: Float64) -> NDArray[np.float32]:
    """Weights (B,) in [0.5, 1] of frames reached by ``motions`` (B, 4, 4).

    Readings of a fast camera are blurred and skewed: the weight is 1 at rest and 0.5 from 0.1 m or
    0.1 rad per frame.
    """
    distance = np.linalg.norm(motions[:, :3, 3], axis=1)
    cosine = (np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    size = np.maximum(distance, np.arccos(np.clip(cosine, -1, 1)))
    return np.maximum(0.5, 1 - size / 0.2).astype(np.float32)


def is_within(a: Float64, b: Float64, distance_m: float, angle_rad: float) -> bool:
    """Whether two poses (4, 4) differ by at most ``distance_m`` and ``angle_rad``."""
    near = np.linalg.norm(a[:3, 3] - b[:3, 3]) <= distance_m
    return bool(near and relative_angle(a[:3, :3], b[:3, :3]) <= angle_rad)


def check_poses(poses: Float64, batch: int) -> Float64:
    """Return poses (B, 4, 4); refuse anything else."""
    if np.ndim(poses) != 3 or len(poses) != batch:
        raise InputError(f"T_world_camera must have shape {(batch, 4, 4)}, got {np.shape(poses)}")
    return np.stack([check_pose(pose, "T_world_camera") for pose in poses])


def check_guesses(guesses: Sequence[ArrayLike | None] | None, batch: int) -> Float64 | None:
    """Guesses (B, 4, 4), NaN for an env without one; None without any. Refuse invalid poses."""
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


@wp.func
def _score(sums: wp.array3d[wp.float64], b: int, k: int) -> wp.float64:
    """Mean truncated cost per model point; a point out of view costs a fixed share."""
    points = sums[b, k, Sum.POINTS]
    visible = sums[b, k, Sum.VISIBLE]
    if points < wp.float64(1.0):
        return wp.float64(1.0e9)
    return (sums[b, k, Sum.COST] + wp.float64(0.8) * (points - visible)) / points


@wp.kernel
def expand_hypotheses(first: Hypotheses, more: Hypotheses, good_score: wp.float64) -> None:
    """Switch on the remaining hypotheses (B, K2) unless one of the first (B, K1) fits well."""
    b = wp.tid()
    best = wp.float64(1.0e9)
    for k in range(first.sums.shape[1]):
        if first.state[b, k] == OFF:
            first.sums[b, k, Sum.POINTS] = wp.float64(0.0)  # no points: the worst score
        best = wp.min(best, _score(first.sums, b, k))
    for k in range(more.state.shape[1]):
        if best > good_score:
            more.state[b, k] = RUNNING
        else:
            more.state[b, k] = OFF
            more.sums[b, k, Sum.POINTS] = wp.float64(0.0)  # no points: the worst score


@wp.kernel
def select_hypothesis(first: Hypotheses, more: Hypotheses, one: Hypotheses) -> None:
    """Select the hypothesis whose points fit best; it becomes the only one, (B, 1)."""
    b = wp.tid()
    # If the view leaves directions unconstrained, all starts fit equally: prefer the predicted one.
    best = first.pose[b, CONSTANT_VELOCITY]
    photometry = first.photometry[b, CONSTANT_VELOCITY]
    best_score = _score(first.sums, b, CONSTANT_VELOCITY)
    for n in range(1, first.pose.shape[1]):
        k = wp.where(n == CONSTANT_VELOCITY, AT_REST, n)
        score = _score(first.sums, b, k)
        if score < best_score * wp.where(k == INITIAL_GUESS, CLEARLY_WORSE, CLEARLY_BETTER):
            best_score = score
            best = first.pose[b, k]
            photometry = first.photometry[b, k]
    for k in range(more.pose.shape[1]):
        score = _score(more.sums, b, k)
        if score < best_score * CLEARLY_BETTER:
            best_score = score
            best = more.pose[b, k]
            photometry = more.photometry[b, k]
    one.pose[b, 0] = best
    one.photometry[b, 0] = photometry
    one.state[b, 0] = RUNNING
