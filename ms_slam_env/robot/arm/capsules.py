"""Capsules around an arm's links, for distances to furniture and between links."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ms_slam_env.robot.arm.chain import Chain, segment_distance

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_BALL = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_NEIGHBOURS = 2  # links this near touch by construction, or joint limits keep them apart


@dataclass(frozen=True)
class LinkCapsules:
    """Capsules (m,) with the link of each, ends (m, 2, 3) in the link's frame, and radius (m,)."""

    link: Int32
    ends: Float64
    radius: Float64


def link_capsules(
    mj: mujoco.MjModel, data: mujoco.MjData, bodies: Int32, T_base_link: Float64
) -> LinkCapsules:
    """Capsules around the colliding geoms of an arm at the state in ``data``.

    Args:
        mj: the model.
        data: after ``mj_kinematics``, joint angles as in ``T_base_link``.
        bodies: (n,) the bodies that the joints move.
        T_base_link: (n + 1, 4, 4) link frames, the base first.
    """
    link_of_body = _links(mj, bodies)
    link, ends, radius = [], [], []
    for geom in range(mj.ngeom):
        collides = mj.geom_contype[geom] or mj.geom_conaffinity[geom]
        if not collides or int(mj.geom_type[geom]) == _PLANE:
            continue
        half, r, axis, centre = _capsule(mj, geom)
        R, position = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        middle, along = position + R @ centre, half * R[:, axis]
        index = link_of_body[mj.geom_bodyid[geom]]
        inverse = np.linalg.inv(T_base_link[index])
        both = np.stack([middle - along, middle + along])
        link.append(index)
        ends.append(both @ inverse[:3, :3].T + inverse[:3, 3])
        radius.append(r)
    return LinkCapsules(
        np.array(link, dtype=np.int32), np.array(ends).reshape(-1, 2, 3), np.array(radius)
    )


def _links(mj: mujoco.MjModel, bodies: Int32) -> dict[int, int]:
    """The link of each body: that of the last chain joint above it, 0 if there is none."""
    link_of_body = {0: 0}
    moved = {int(body): index + 1 for index, body in enumerate(bodies)}
    for body in range(1, mj.nbody):  # parents come first
        link_of_body[body] = moved.get(body, link_of_body[int(mj.body_parentid[body])])
    return link_of_body


def _capsule(mj: mujoco.MjModel, geom: int) -> tuple[float, float, int, Float64]:
    """Half length, radius, axis and centre (3,), in the geom's frame, of a capsule around it."""
    kind, size = int(mj.geom_type[geom]), mj.geom_size[geom]
    if kind == _BALL:
        return 0.0, float(size[0]), 2, np.zeros(3)
    if kind in _ROUND:
        return float(size[1]), float(size[0]), 2, np.zeros(3)
    # Boxes, ellipsoids and meshes by their bounding box, along its longest side. Ending the axis
    # before the corners costs width and saves more length.
    centre, half_sides = mj.geom_aabb[geom, :3].copy(), mj.geom_aabb[geom, 3:]
    axis = int(np.argmax(half_sides))
    across = float(np.linalg.norm(np.delete(half_sides, axis)))
    half = max(0.0, float(half_sides[axis]) - 0.5 * across)
    return half, math.hypot(across, half_sides[axis] - half), axis, centre


def separate_pairs(chain: Chain, home: Float64) -> Chain:
    """The chain with its ``self_pairs``: capsules more than two links apart, free at ``home``."""
    m = len(chain.capsule_link)
    first, second = np.triu_indices(m, 1)
    far = np.abs(chain.capsule_link[first] - chain.capsule_link[second]) > _NEIGHBOURS
    first, second = first[far], second[far]
    ends = chain.capsules(home)
    gap = segment_distance(ends[first], ends[second])
    gap = gap - chain.capsule_radius[first] - chain.capsule_radius[second]
    free = gap > 0
    pairs = np.stack([first[free], second[free]], axis=1).astype(np.int32)
    return dataclasses.replace(chain, self_pairs=pairs, self_gap=gap[free])


def with_column(chain: Chain, home: Float64, radius_m: float, height_m: float) -> Chain:
    """The chain whose base stands on an upright column that its links must not touch."""
    column = np.array([[[0.0, 0.0, -radius_m], [0.0, 0.0, -max(height_m, radius_m)]]])
    extended = dataclasses.replace(
        chain,
        capsule_link=np.append(chain.capsule_link, 0).astype(np.int32),
        capsule_ends=np.concatenate([chain.capsule_ends, column]),
        capsule_radius=np.append(chain.capsule_radius, radius_m),
    )
    return separate_pairs(extended, home)
