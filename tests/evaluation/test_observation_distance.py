"""Wasserstein distance of what is observed: closed forms, samples, and what it needs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.observation_distance import noise, observation_distance
from ms_slam_env.evaluation.sequence_divergence import sequence_divergence, table
from ms_slam_env.geometry import make_pose, so3_exp
from ms_slam_env.sequences import HandheldPath, Sequence, open_sequence

K = xtion("80x60")


def wall(z: float) -> RGBDFrame:
    return RGBDFrame(np.zeros((60, 80, 3), np.uint8), np.full((60, 80), z, np.float32))


def test_a_step_sideways_moves_every_observation_by_it() -> None:
    step = make_pose(np.eye(3), [0.03, 0.0, 0.0])
    assert observation_distance(wall(2.0), wall(2.0), step, K) == pytest.approx(0.03)
    assert observation_distance(wall(2.0), wall(2.0), np.eye(4), K) == 0


def test_a_turn_moves_them_by_their_distance() -> None:
    turn = make_pose(so3_exp([0.0, 0.0, 0.02]), [0, 0, 0])  # about the axis: depth stays
    points = K.rays()[::2, ::2].reshape(-1, 3) * 2.0
    chord = 2 * np.sin(0.01) * np.hypot(points[:, 0], points[:, 1])
    found = observation_distance(wall(2.0), wall(2.0), turn, K)
    assert found == pytest.approx(np.sqrt((chord**2).mean()), rel=0.05)  # corners leave the view


def test_coming_nearer_changes_the_noise_too() -> None:
    ahead = make_pose(np.eye(3), [0.0, 0.0, 0.5])
    found = observation_distance(wall(3.0), wall(2.5), ahead, K)
    assert found > 0.5
    point = np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, 2.5]])
    sigma = [noise(p, K)[0] for p in point]
    expected = np.sqrt(0.25 + ((sigma[0] - sigma[1]) ** 2).sum())
    assert found == pytest.approx(expected, rel=1e-6)
    # The closed form against the transport between samples of the two Gaussians.
    rng = np.random.default_rng(0)
    a, b = (p + rng.normal(size=(600, 3)) * s for p, s in zip(point, sigma, strict=True))
    cost = cdist(a, b) ** 2
    rows, columns = linear_sum_assignment(cost)
    assert np.sqrt(cost[rows, columns].mean()) == pytest.approx(expected, rel=0.02)


def test_nothing_in_common_is_no_number() -> None:
    behind = make_pose(so3_exp([0.0, np.pi, 0.0]), [0, 0, 0])
    assert np.isnan(observation_distance(wall(2.0), wall(2.0), behind, K))
    hidden = make_pose(np.eye(3), [0.01, 0, 0])
    assert np.isnan(observation_distance(wall(3.0), wall(1.0), hidden, K))  # a door shut before it


def test_of_a_sequence_it_is_in_metres_and_needs_true_poses() -> None:
    path = HandheldPath(6)
    sequence = open_sequence("table:1000:none", "80x60", path=path, with_truth=True)
    found = sequence_divergence(sequence, measure="wasserstein")
    assert found.divergences.shape == (5, 1)
    steps = np.linalg.norm(np.diff(sequence.poses[:, :3, 3], axis=0), axis=1)
    assert 0.3 * steps.mean() < found.divergences.mean() < 10 * steps.mean()
    assert "observation" in table([found]).as_markdown()
    blind = Sequence(tuple(sequence.frames), np.full((6, 4, 4), np.nan), K, "blind")
    with pytest.raises(InputError, match="needs the true pose of every frame, and 6 of 6"):
        sequence_divergence(blind, measure="wasserstein")
    with pytest.raises(InputError, match="valid choices: kl, windowed-kl, earth-movers, wasser"):
        sequence_divergence(sequence, measure="cosine")
