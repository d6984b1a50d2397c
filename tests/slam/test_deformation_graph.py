"""The embedded deformation graph against finite differences and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.geometry import make_pose, so3_exp, transform_points
from ms_slam_env.slam.shared.rows import join
from ms_slam_env.slam.surfel.map_deformation import (
    NEIGHBOURS,
    TWIST_M,
    W_CON,
    W_REG,
    W_ROT,
    Constraints,
    DeformationGraph,
    Energy,
    identity,
    no_constraints,
    optimise,
    pack,
    sample_graph,
    unpack,
)


def cloud(count: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points along a bent path with their times."""
    rng = np.random.default_rng(seed)
    times = np.arange(count, dtype=float)
    along = times / count * 3.0
    centre = np.stack([along, np.sin(along), 0.2 * along], axis=1)
    return centre + rng.normal(0, 0.15, (count, 3)), times


def fixed(sources: np.ndarray, times: np.ndarray, targets: np.ndarray) -> Constraints:
    return Constraints(sources, times, targets, np.full(len(sources), np.nan))


def random_unknowns(graph: DeformationGraph, seed: int) -> np.ndarray:
    return pack(identity(graph)) + np.random.default_rng(seed).normal(0, 0.3, 12 * len(graph))


@settings(max_examples=30, deadline=None)
@given(st.integers(6, 60), st.integers(0, 1000))
def test_weights_sum_to_one_over_the_nearest_nodes_in_time_and_space(count: int, seed: int) -> None:
    points, times = cloud(seed=seed)
    graph = sample_graph(points, times, count)
    nodes, weights = graph.influence(points, times)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    assert (weights > 0).all()
    for n in range(0, len(points), 37):
        nearest_time = np.abs(graph.times - times[n]).argmin()
        low = np.clip(nearest_time - graph.window // 2, 0, len(graph) - graph.window)
        window = range(low, low + graph.window)
        distance = {m: np.linalg.norm(graph.positions[m] - points[n]) for m in window}
        expected = sorted(window, key=lambda m, d=distance: (d[m], m))
        assert list(nodes[n]) == expected[:NEIGHBOURS]
        farthest = distance[expected[NEIGHBOURS]]
        raw = [(1 - distance[m] / farthest) ** 2 for m in expected[:NEIGHBOURS]]
        np.testing.assert_allclose(weights[n], np.array(raw) / sum(raw), atol=1e-3)


def test_every_node_is_joined_to_its_neighbours_in_time() -> None:
    graph = sample_graph(*cloud(), 9)
    neighbours = [set(graph.edges()[graph.edges()[:, 0] == n, 1]) for n in range(9)]
    assert neighbours[4] == {2, 3, 5, 6}
    assert neighbours[0] == {1, 2, 3, 4}
    assert neighbours[8] == {4, 5, 6, 7}


def test_the_energy_is_that_of_the_paper() -> None:
    points, times = cloud(60)
    graph = sample_graph(points, times, 8)
    constraints = join(
        [
            fixed(points[:5], times[:5], points[:5] + 0.1),
            Constraints(points[50:], times[50:], points[10:20], times[10:20]),
        ]
    )
    x = random_unknowns(graph, 3)
    motion = unpack(graph, x)
    expected = 0.0
    for R in motion.R:
        expected += W_ROT * np.sum((R.T @ R - np.eye(3)) ** 2)
    g, t = graph.positions, motion.t
    for own, other in graph.edges():
        gap = motion.R[own] @ (g[other] - g[own]) + g[own] + t[own] - g[other] - t[other]
        expected += W_REG * gap @ gap
        expected += W_REG * TWIST_M**2 * np.sum((motion.R[own] - motion.R[other]) ** 2)
    expected += W_CON * np.sum(constraints.errors(motion) ** 2)
    assert np.sum(Energy(graph, constraints).residuals(x) ** 2) == pytest.approx(expected)


def test_derivatives_agree_with_finite_differences() -> None:
    points, times = cloud(60)
    graph = sample_graph(points, times, 7)
    constraints = join(
        [
            fixed(points[:3], times[:3], points[:3] + 0.1),
            Constraints(points[55:], times[55:], points[10:15], times[10:15]),
        ]
    )
    energy = Energy(graph, constraints)
    x = random_unknowns(graph, 1)
    jacobian = energy.jacobian(x).toarray()
    h = 1e-6
    for column in range(len(x)):
        e = np.zeros(len(x))
        e[column] = h
        difference = (energy.residuals(x + e) - energy.residuals(x - e)) / (2 * h)
        np.testing.assert_allclose(jacobian[:, column], difference, atol=1e-7)


def test_a_step_is_the_least_squares_solution() -> None:
    points, times = cloud(60)
    graph = sample_graph(points, times, 7)
    energy = Energy(graph, fixed(points, times, points + 0.1))
    x = random_unknowns(graph, 2)
    dense = np.linalg.lstsq(energy.jacobian(x).toarray(), -energy.residuals(x), rcond=None)[0]
    np.testing.assert_allclose(energy.step(x), dense, atol=1e-5)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_a_rigid_motion_of_all_constraints_is_reproduced(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, times = cloud(seed=seed)
    motion = make_pose(so3_exp(rng.uniform(-0.4, 0.4, 3)), rng.uniform(-1, 1, 3))
    graph = sample_graph(points, times, 25)
    some = rng.choice(len(points), 60, replace=False)
    constraints = fixed(points[some], times[some], transform_points(motion, points[some]))
    found = optimise(graph, constraints)
    assert np.sum(Energy(graph, constraints).residuals(pack(found)) ** 2) < 1e-12
    np.testing.assert_allclose(
        found.points(points, times), transform_points(motion, points), atol=1e-5
    )


def test_without_constraints_nothing_moves() -> None:
    points, times = cloud()
    found = optimise(sample_graph(points, times, 20), no_constraints())
    np.testing.assert_allclose(found.points(points, times), points, atol=1e-12)


def test_pins_hold_what_is_in_place_already() -> None:
    points, times = cloud()
    found = optimise(sample_graph(points, times, 20), fixed(points, times, points))
    np.testing.assert_allclose(found.points(points, times), points, atol=1e-9)


def strip(curvature: float) -> tuple[np.ndarray, np.ndarray]:
    """A strip 2 m long and 0.2 m wide, bent into an arc of a circle, row after row."""
    s, across = np.meshgrid(np.linspace(0, 2, 101), np.linspace(-0.1, 0.1, 5), indexing="ij")
    s, across = s.ravel(), across.ravel()
    if curvature == 0:
        return np.stack([s, across, np.zeros_like(s)], axis=1), s
    radius = 1 / curvature
    arc = [radius * np.sin(s * curvature), across, radius * (1 - np.cos(s * curvature))]
    return np.stack(arc, axis=1), s


def test_a_bent_strip_is_straightened() -> None:
    bent, times = strip(0.3)
    straight, _ = strip(0.0)
    graph = sample_graph(bent, times, 40)
    rows = np.arange(0, 505, 25)[:, None] + np.arange(5)  # every fifth row is told where to go
    some = rows[rows < len(bent)].ravel()
    found = optimise(graph, fixed(bent[some], times[some], straight[some]))
    before = np.linalg.norm(bent - straight, axis=1)
    error = np.linalg.norm(found.points(bent, times) - straight, axis=1)
    assert before.max() > 0.5
    assert error.max() < 0.01
    assert np.sqrt(np.mean(error**2)) < 0.003


DRIFT = np.array([0.05, -0.08, 0.03])


def drifted_ring() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on a ring, their angles, and where drift took them: the ends are DRIFT apart."""
    angle = np.linspace(0, 2 * np.pi, 400)
    height = np.random.default_rng(0).uniform(-0.2, 0.2, 400)
    ring = np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    return ring, angle, ring + (angle / (2 * np.pi))[:, None] * DRIFT


def rms(differences: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=1))))


def test_a_drift_that_grows_along_the_way_is_spread_over_it() -> None:
    ring, angle, drifted = drifted_ring()
    end, start = angle > 6.0, angle < 0.28
    closed = fixed(drifted[end], angle[end], drifted[end] - DRIFT)
    pinned = fixed(drifted[start], angle[start], drifted[start])
    found = optimise(sample_graph(drifted, angle, 60), join([closed, pinned]))
    assert rms(found.points(drifted, angle) - ring) < 0.35 * rms(drifted - ring)


def test_a_relative_constraint_draws_both_ends_together() -> None:
    _, angle, drifted = drifted_ring()
    graph = sample_graph(drifted, angle, 60)
    end, start = angle > 6.0, angle < 0.28
    constraints = Constraints(drifted[end], angle[end], drifted[end] - DRIFT, 0 * angle[end])
    found = optimise(graph, constraints)
    assert constraints.errors(identity(graph)).mean() == pytest.approx(np.linalg.norm(DRIFT))
    assert constraints.errors(found).max() < 0.1 * np.linalg.norm(DRIFT)
    moves = [found.points(drifted[part], angle[part]) - drifted[part] for part in (start, end)]
    assert all(rms(move) > 0.3 * np.linalg.norm(DRIFT) for move in moves)
