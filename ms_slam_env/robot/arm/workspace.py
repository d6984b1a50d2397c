"""Where an arm can bring its camera."""

from __future__ import annotations

import numpy as np

from ms_slam_env.geometry import Float64
from ms_slam_env.robot.arm.arm import ArmEmbodiment
from ms_slam_env.robot.arm.clearance import LinkClearance
from ms_slam_env.robot.arm.feasibility import LIMIT_MARGIN_RAD

_LONGEST_RAD = 1.0  # of an edge of the tree, in the joint that turns farthest
_APART_RAD = 0.05  # of two postures on it that are looked at


def camera_poses(arm: ArmEmbodiment, edges: int = 600) -> Float64:
    """Poses (K, 4, 4) in the world that the arm can bring its camera to from where it is.

    Ends of the edges of a rapidly exploring random tree in joint space (LaValle, 1998), from a
    fixed seed, on which no link touches furniture or another.

    Args:
        arm: standing in a scene.
        edges: attempts to grow the tree.
    """
    chain, start = arm.chain, arm.planning_state()[0]
    links = LinkClearance(chain, arm.clearance_field, 0.0)
    least = min(0.0, float(links.least(start[None])[0]))  # who touches already may go away
    low = np.maximum(chain.lower + LIMIT_MARGIN_RAD, start - np.pi)
    high = np.minimum(chain.upper - LIMIT_MARGIN_RAD, start + np.pi)
    rng = np.random.default_rng(0)
    tree = np.array([start])
    for target in rng.uniform(np.minimum(low, high), np.maximum(low, high), (edges, len(start))):
        nearest = tree[np.argmin(np.linalg.norm(tree - target, axis=1))]
        edge = target - nearest
        far = float(np.abs(edge).max())
        edge *= min(1.0, _LONGEST_RAD / max(far, 1e-9))
        parts = max(1, int(np.ceil(np.abs(edge).max() / _APART_RAD)))
        way = nearest + edge * (np.arange(1, parts + 1) / parts)[:, None]
        free = int(np.cumprod(links.least(way) >= least).sum())
        if free:
            tree = np.concatenate([tree, way[free - 1 : free]])
    return arm.T_world_base @ chain.camera_pose(tree)
