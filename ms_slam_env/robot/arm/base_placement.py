"""Choose an arm's base pose and posture at the start of an episode."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env.errors import InputError, UnreachableError
from ms_slam_env.geometry import invert, make_pose, so3_exp, transform_points
from ms_slam_env.robot.action_primitives import decompose
from ms_slam_env.robot.arm.arm_config import ArmConfig
from ms_slam_env.robot.arm.chain import Chain, with_column
from ms_slam_env.robot.arm.clearance import ClearanceField
from ms_slam_env.robot.arm.feasibility import LIMIT_MARGIN_RAD, Feasibility
from ms_slam_env.robot.arm.inverse_kinematics import (
    PITCHES,
    STEP_M,
    STEP_RAD,
    Samples,
    effort,
    ik_seeds_at,
    links_apart,
    sample_joints,
    solve_pose,
    turn_upright,
    wrap_joints,
)
from ms_slam_env.robot.arm.model import ArmModel
from ms_slam_env.scenes.scene import Scene, enclosed, outside, words

COLUMN_RADIUS_M = 0.08
"""Radius of the column that carries a base above the floor."""

_PROBED = 4  # postures whose possible motions are counted
_ENOUGH = 46  # possible motions at which the search stops
_PITCHES_TRIED = 2  # nearest to that of the camera
_SEEDS = 24  # starting points of inverse kinematics for a given base
_MET_M = 0.02  # points closer than this to a surface are on it
_GRID_M = 0.05  # vertical distance between checked points of a column


def place_arm(
    model: ArmModel, scene: Scene, T_world_camera: Float64, config: ArmConfig
) -> tuple[Float64, Float64]:
    """Find base pose T_world_base (4, 4) and joint angles (n,) that hold the camera at a pose.

    Without ``config.base`` the arm stands upright on a column on the floor. Of the collision-free
    postures within its limits, one that makes most of the 49 motions possible is chosen. With
    ``config.base`` only the joint angles are free.

    Raises:
        UnreachableError: no such base or joint angles for this camera pose; the message says why.
        InputError: an arm cannot stand at ``config.base``, whatever the camera's pose.
    """
    if config.base is None:
        return _stand_anywhere(model, scene, T_world_camera, config)
    return _stand_on_base(model, scene, T_world_camera, config)


def standing_chain(model: ArmModel, config: ArmConfig) -> Chain:
    """The arm's chain, including the column that its links must not touch if it has one."""
    return model.chain if config.base is not None else _on_column(model)


@lru_cache(maxsize=8)
def _on_column(model: ArmModel) -> Chain:
    return with_column(model.chain, model.home, COLUMN_RADIUS_M, reach_m(model.chain))


def _planning(config: ArmConfig) -> ArmConfig:
    """The parts of a configuration that the search for postures depends on, for caching."""
    return ArmConfig(
        speed_m_s=config.speed_m_s, speed_rad_s=config.speed_rad_s, clearance_m=config.clearance_m
    )


def reach_m(chain: Chain) -> float:
    """Distance from the base that no part of the arm exceeds: that of the stretched chain."""
    to_link = _stretched(chain)
    ends = np.linalg.norm(chain.capsule_ends, axis=-1).max(axis=-1, initial=0.0)
    skin = to_link[chain.capsule_link] + ends + chain.capsule_radius
    return float(max(camera_reach_m(chain), skin.max(initial=0.0)))


def camera_reach_m(chain: Chain) -> float:
    """Distance from the base that the camera does not exceed."""
    return float(_stretched(chain)[-1] + np.linalg.norm(chain.T_last_camera[:3, 3]))


def _stretched(chain: Chain) -> Float64:
    """(n + 1,) distances along the chain from the base to each link."""
    steps = np.linalg.norm(chain.T_parent_joint[:, :3, 3], axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _stand_anywhere(
    model: ArmModel, scene: Scene, T_world_camera: Float64, config: ArmConfig
) -> tuple[Float64, Float64]:
    """Choose a posture with the camera's pitch; the base pose follows from it."""
    _check_camera(scene, T_world_camera)
    chain = standing_chain(model, config)
    up = T_world_camera[2, :3]
    pitch = np.arcsin(np.clip(up[2], -1, 1))
    nearest = np.argsort(np.abs(PITCHES - pitch), kind="stable")[:_PITCHES_TRIED]
    postures = [ik_seeds_at(chain, tuple(model.home), _planning(config), int(i)) for i in nearest]
    motions = np.concatenate([some.motions for some in postures])
    found = np.concatenate([some.q for some in postures])
    if len(found) == 0:
        raise UnreachableError(
            f"arm {model.path.stem} has no posture that holds the camera upright and inclined by "
            f"{np.degrees(PITCHES[nearest[0]]):.0f} degrees, as at {words(T_world_camera[:3, 3])}"
        )
    q, upright = turn_upright(chain, found, up)
    q = wrap_joints(chain, q)
    bendable = upright & chain.within_limits(q, LIMIT_MARGIN_RAD) & links_apart(chain, q)
    T_world_base = T_world_camera @ invert(chain.camera_pose(q))
    supported = _column_is_free(scene, T_world_base[:, :3, 3], T_world_camera[:3, 3])
    clear = _links_are_free(chain, scene, T_world_base, q, config.clearance_m)
    possible = np.flatnonzero(bendable & supported & clear)
    if len(possible) == 0:
        raise UnreachableError(
            f"arm {model.path.stem} cannot hold the camera at "
            f"{words(T_world_camera[:3, 3])} in scene {scene.name}: of {len(q)} postures "
            f"{int((~bendable).sum())} do not reach that inclination, "
            f"{int((bendable & ~supported).sum())} have no free floor for the base, in "
            f"{int((bendable & supported & ~clear).sum())} the arm would touch furniture"
        )
    order = possible[np.argsort(-motions[possible], kind="stable")]
    return _most_able(model, scene, config, T_world_base[order], q[order])


def _stand_on_base(
    model: ArmModel, scene: Scene, T_world_camera: Float64, config: ArmConfig
) -> tuple[Float64, Float64]:
    """Solve inverse kinematics from a given base."""
    assert config.base is not None
    chain = standing_chain(model, config)
    x, y, z, yaw = config.base
    T_world_base = make_pose(so3_exp([0.0, 0.0, yaw]), [x, y, z])
    _check_base(model, scene, T_world_base)
    _check_camera(scene, T_world_camera)
    samples = sample_joints(chain, tuple(model.home), _planning(config))
    target = invert(T_world_base) @ T_world_camera
    found = solve_pose(chain, _seeds(samples, model.home, target), target)
    reached = found.accurate()
    where = f"start pose {words(T_world_camera[:3, 3])}"
    arm = f"arm {model.path.stem} from base {words(T_world_base[:3, 3])}"
    if not reached.any():
        distance, reach = float(np.linalg.norm(target[:3, 3])), camera_reach_m(chain)
        raise UnreachableError(
            f"{where} unreachable for {arm}: it is {distance:.2f} m away from the base, the arm "
            f"holds its camera at most {reach:.2f} m away, and not in every direction there"
        )
    q = wrap_joints(chain, found.q[reached])
    q = q[chain.within_limits(q, LIMIT_MARGIN_RAD)]
    if len(q) == 0:
        raise UnreachableError(f"{where} is outside the joint limits of {arm}")
    q = q[links_apart(chain, q)]
    if len(q) == 0:
        raise UnreachableError(f"{where} would make the links touch each other: {arm}")
    bases = np.tile(T_world_base, (len(q), 1, 1))
    clear = _links_are_free(chain, scene, bases, q, config.clearance_m)
    if not clear.any():
        raise UnreachableError(f"{where} would make the links touch furniture: {arm}")
    q = q[clear]
    order = np.argsort(effort(chain, q, config.speed_m_s, config.speed_rad_s), kind="stable")
    return _most_able(model, scene, config, bases[: len(q)], q[order])


def _most_able(
    model: ArmModel, scene: Scene, config: ArmConfig, T_world_base: Float64, q: Float64
) -> tuple[Float64, Float64]:
    """The base, of (s, 4, 4) with postures (s, n), that has the most possible motions."""
    chain = standing_chain(model, config)
    motions = decompose(STEP_M, STEP_RAD)
    best, most = 0, -1
    for index in range(min(_PROBED, len(q))):
        clearance_field = ClearanceField(scene, T_world_base[index], reach_m(chain))
        feasibility = Feasibility(chain, clearance_field, config)
        result = feasibility.probe(q[index], chain.camera_pose(q[index]) @ motions)
        count = int(result.ok.sum())
        if count > most:
            best, most = index, count
        if most >= _ENOUGH:
            break
    return T_world_base[best], q[best]


def _seeds(samples: Samples, home: Float64, target: Float64) -> Float64:
    """Joint angles (s, n) that put the camera near a target (4, 4), and the home posture."""
    cameras = samples.T_base_camera
    apart = np.linalg.norm(cameras[:, :3, 3] - target[:3, 3], axis=1)
    cosine = 0.5 * (np.einsum("sij,ij->s", cameras[:, :3, :3], target[:3, :3]) - 1)
    turned = np.arccos(np.clip(cosine, -1, 1))
    nearest = np.argsort(apart + 0.3 * turned, kind="stable")[:_SEEDS]
    return np.concatenate([home[None], samples.q[nearest]])


def _check_camera(scene: Scene, T_world_camera: Float64) -> None:
    """Refuse a camera that is not in free space.

    Raises:
        UnreachableError: naming its position.
    """
    where = enclosed(scene, T_world_camera[:3, 3])
    if where:
        raise UnreachableError(f"start pose {words(T_world_camera[:3, 3])} lies {where}")


def _check_base(model: ArmModel, scene: Scene, T_world_base: Float64) -> None:
    """Refuse a base outside the scene or inside an object; it may stand on one.

    Raises:
        InputError: naming its position, or the free space around it.
    """
    where = outside(scene, T_world_base[:3, 3])
    if where:
        raise InputError(f"arm.base at {words(T_world_base[:3, 3])} lies {where}")
    chain = model.chain
    fixed = np.flatnonzero(chain.capsule_link == 0)
    for index in fixed:
        a, b = transform_points(T_world_base, chain.capsule_ends[index])
        points = a + np.linspace(0, 1, 5)[:, None] * (b - a)
        # the surface below may be as near as the base plane
        height = points[:, 2] - T_world_base[2, 3] - scene.clearance_grid_m
        need = np.clip(height, 0.0, chain.capsule_radius[index])
        free = scene.clearance(points)
        worst = int(np.argmax(need - free))
        if free[worst] < need[worst]:
            raise InputError(
                f"arm inside furniture: arm.base at {words(T_world_base[:3, 3])} has "
                f"{free[worst]:.3f} m of free space in scene {scene.name}, "
                f"needs {need[worst]:.3f} m"
            )


def _column_is_free(scene: Scene, bases: Float64, camera: Float64) -> Bool:
    """(s,) whether a column fits between each base (s, 3) and the floor near the camera."""
    floor = _floor_below(scene, camera)
    height = bases[:, 2] - floor
    steps = max(2, int(np.ceil(max(height.max(), 0.0) / _GRID_M)) + 1)
    share = np.linspace(0.0, 1.0, steps)
    z = floor + share * np.maximum(height, 0.0)[:, None]  # (s, steps)
    points = np.stack([*(np.broadcast_to(bases[:, k, None], z.shape) for k in (0, 1)), z], axis=-1)
    free = scene.clearance(points.reshape(-1, 3)).reshape(z.shape)
    need = np.clip(z - floor - scene.clearance_grid_m, 0.0, COLUMN_RADIUS_M)
    return np.asarray((height >= 0) & (free >= need).all(axis=1))


def _floor_below(scene: Scene, camera: Float64) -> float:
    """Lowest height hit when going level up to 1.2 m from the camera, then straight down."""
    ticks = np.arange(-1.2, 1.3, 0.4)
    aside = np.stack(np.meshgrid(ticks, ticks, [0.0], indexing="ij"), axis=-1).reshape(-1, 1, 3)
    level = camera + aside * np.linspace(0.0, 1.0, 60)[:, None]  # (c, 60, 3)
    open_way = (scene.clearance(level.reshape(-1, 3)) > _MET_M).reshape(level.shape[:2]).all(axis=1)
    down = np.arange(0.0, 3.0, 0.5 * _GRID_M)
    points = level[open_way, -1:] - down[:, None] * np.array([0.0, 0.0, 1.0])
    free = scene.clearance(points.reshape(-1, 3)).reshape(points.shape[:2])
    met = np.logical_or.accumulate(free <= _MET_M, axis=-1)
    bottom = np.where(met, np.inf, points[..., 2] - free)  # the space goes on down to there
    return float(bottom.min(initial=camera[2]))


def _links_are_free(
    chain: Chain, scene: Scene, T_world_base: Float64, q: Float64, clearance_m: float
) -> Bool:
    """(s,) whether the moving links of arms (s, n) on bases (s, 4, 4) keep their clearance."""
    moving = chain.capsule_link > 0
    ends = chain.capsules(q)[:, moving]  # (s, m, 2, 3)
    share = np.linspace(0, 1, 4)[:, None]
    points = ends[..., :1, :] + share * (ends[..., 1:, :] - ends[..., :1, :])  # (s, m, 4, 3)
    world = np.einsum("sij,smkj->smki", T_world_base[:, :3, :3], points)
    world += T_world_base[:, None, None, :3, 3]
    free = scene.clearance(world.reshape(-1, 3)).reshape(points.shape[:-1])
    need = chain.capsule_radius[moving] + clearance_m
    return np.asarray((free >= need[:, None]).all(axis=(1, 2)))
