"""The pose graph: its D-optimality by counting trees, its edges by a loop over points."""

from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from ms_slam_baselines.graph_dopt import GraphDOptimality, graph_d_optimality, shares_seen

import ms_slam_env  # noqa: F401 -- registers the environments
from ms_slam_env.camera import xtion
from ms_slam_env.geometry import invert, make_pose, so3_exp

RNG = np.random.default_rng(0)
K = xtion("160x120")


def trees_by_enumeration(weights):
    """Sum over all spanning trees of the product of their weights."""
    n = len(weights)
    pairs = [(i, j) for i, j in combinations(range(n), 2) if weights[i, j] > 0]
    total = 0.0
    for edges in combinations(pairs, n - 1):
        parts = list(range(n))
        for i, j in edges:
            parts = [parts[j] if part == parts[i] else part for part in parts]
        if len(set(parts)) == 1:
            total += float(np.prod([weights[edge] for edge in edges]))
    return total


@pytest.mark.parametrize("n", [2, 3, 5])
def test_d_optimality_counts_weighted_spanning_trees(n):
    weights = np.triu(RNG.uniform(0.5, 5, (n, n)) * (RNG.random((n, n)) < 0.8), 1)
    weights[np.arange(n - 1), np.arange(1, n)] = 1.5  # connected
    expected = (n * trees_by_enumeration(weights)) ** (1 / n)
    assert graph_d_optimality(weights + weights.T) == pytest.approx(expected)


def test_a_loop_makes_a_graph_better_and_a_long_arm_worse():
    chain = np.diag(np.full(4, 2.0), 1)
    loop = chain.copy()
    loop[0, 4] = 2.0
    longer = np.diag(np.full(5, 0.2), 1)
    longer[:5, :5] = chain
    found = [graph_d_optimality(w + w.T) for w in (chain, loop, longer)]
    assert found[2] < found[0] < found[1]


def test_shares_are_those_of_points_in_the_image():
    surfaces = RNG.uniform(-3, 3, (3, 80, 3))
    surfaces[1, 10:30] = np.nan  # without a reading
    surfaces[2] = np.nan
    poses = np.stack([make_pose(so3_exp(v[:3]), v[3:]) for v in RNG.normal(size=(5, 6))])
    shares = shares_seen(surfaces, poses, K)
    assert shares.shape == (3, 5)
    for points, row in zip(surfaces, shares, strict=True):
        known = points[np.isfinite(points[:, 0])]
        for share, pose in zip(row, poses, strict=True):
            count = 0
            for point in known:
                x, y, z = invert(pose)[:3, :3] @ point + invert(pose)[:3, 3]
                if z > 0:
                    u, v = K.fx * x / z + K.cx, K.fy * y / z + K.cy
                    count += 0 <= u < K.width and 0 <= v < K.height
            assert share == pytest.approx(count / max(len(known), 1))


@pytest.fixture(scope="module")
def played():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", scene="living_room", scene_seed=3)
    observation, info = env.reset(seed=3)
    planner = GraphDOptimality(env.unwrapped, 0)
    planner.reset()
    for _ in range(20):
        action = planner.act(observation, info)
        assert info["action_mask"][action]
        observation, _, _, _, info = env.step(action)
    yield planner
    env.close()


def test_keyframes_are_apart_and_all_joined(played):
    graph = played.weights + played.weights.T
    assert len(graph) == len(played.keyframes) > 3
    assert graph_d_optimality(graph) > 0  # connected: some tree spans it
    assert (played.weights == np.triu(played.weights, 1)).all()
    for n, keyframe in enumerate(played.keyframes):
        others = played.keyframes[:n]
        played.keyframes, kept = others, played.keyframes
        assert played.has_moved_on(keyframe.T_world_camera)
        played.keyframes = kept


def test_a_way_that_sees_known_surface_again_is_better_than_if_it_did_not(played):
    here = played.keyframes[-1].T_world_camera
    first = played.keyframes[0].T_world_camera
    with_loops = played.connected_by(here, first)
    kept = played.keyframes
    played.keyframes = [one._replace(surface=one.surface + 100.0) for one in kept]
    assert with_loops > played.connected_by(here, first)
    played.keyframes = kept
