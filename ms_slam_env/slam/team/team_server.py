"""The server of a team: one pose graph over all robots' keyframes, one map of their frames.

Qu, Zhang, Yang, Dong, "USME", Navigation Positioning and Timing 2021, section 4: the back end of
several robots receives their keyframes, optimises the poses of every robot, and fuses, denoises and
optimises their maps. The graph contains the motion between neighbouring keyframes as estimated by
each robot's SLAM, and poses of one robot's keyframes in another's map from registration (GICP). A
map averages many frames, so this fits better than registering two frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.arrays import Float64, Int64
from ms_slam_env.camera import Intrinsics, RGBDFrame
from ms_slam_env.config import Checked, bounded
from ms_slam_env.geometry import invert, relative_angle, se3_exp, se3_log, transform_points
from ms_slam_env.geometry.cloud_registration import register_clouds
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.slam.shared.map_fit import query_frames
from ms_slam_env.slam.slam_backend import SlamBackend
from ms_slam_env.slam.sparse.pose_graph import Edge, optimise_poses
from ms_slam_env.slam.team.relative_map_poses import RobotRun

AGREE_M, AGREE_DEG = 0.2, 5.0
"""A keyframe is left out if its pose in another map is farther from that of the merged maps."""
LEAST_SHARE = 0.6  # share of a keyframe's points that must lie on the other map
MATCH_M, MATCH_RAD = 0.01, 0.006  # standard deviation of a keyframe registered in another map
_FAR_M = 4.0  # readings beyond are too noisy to be registered
_VOXEL_M = 0.02
_FEWEST, _MATCHED = 200, 800  # least and largest number of points to register
_SURE = 5e-4  # least standard deviation of a motion, metres and radians


@dataclass(frozen=True)
class ServerConfig(Checked):
    """How the keyframes of a team are joined.

    Attributes:
        keyframes: number per robot, evenly spread over its tracked frames.
        cutoff_m: largest distance of corresponding points in the registration.
        drift: error of the motion between neighbouring keyframes, as a share of it.
    """

    keyframes: int = bounded(30, 2, 1000)
    cutoff_m: float = bounded(0.04, 1e-3, 1.0)
    drift: float = bounded(0.003, 1e-6, 1.0)


@dataclass(frozen=True)
class TeamEstimate:
    """The server's result for a team.

    Attributes:
        trajectories: by robot (N, 4, 4), T_world_camera of all its frames in the common frame.
        links: number of keyframes registered in another robot's map.
    """

    trajectories: Mapping[int, Float64]
    links: int


@dataclass(frozen=True)
class _Keyframe:
    """A robot's frame in the pose graph."""

    robot: int
    index: int  # of the frame
    T_world_camera: Float64  # (4, 4) in the common frame, before optimisation
    cloud: Float64  # (M, 3) in the camera's frame


def optimise_team(
    robots: Sequence[RobotRun],
    T_world_map: Mapping[int, Float64],
    config: ServerConfig | None = None,
) -> TeamEstimate:
    """Optimise the robots' trajectories so that their views of common places agree.

    Args:
        robots: all robots; those in ``T_world_map`` are joined.
        T_world_map: (4, 4) by robot, the pose of its map in the common frame. The first keyframe of
            the first robot stays fixed.
        config: parameters of the graph.
    """
    config = config or ServerConfig()
    keyframes = [
        keyframe
        for k, T in T_world_map.items()
        for keyframe in _keyframes(k, robots[k], T, config.keyframes)
    ]
    poses = np.stack([keyframe.T_world_camera for keyframe in keyframes])
    own = [
        _motion(a, b, keyframes, config.drift)
        for a, b in itertools.pairwise(range(len(keyframes)))
        if keyframes[a].robot == keyframes[b].robot
    ]
    maps = {
        k: transform_points(T, voxel_downsample(robots[k].backend.surface_points(), _VOXEL_M))
        for k, T in T_world_map.items()
    }
    found = _links(keyframes, maps, config)
    fixed = np.arange(len(poses)) == 0
    optimised = optimise_poses(poses, [*own, *found], fixed) if found else poses
    trajectories = {}
    for k, T in T_world_map.items():
        own_keys = [n for n, keyframe in enumerate(keyframes) if keyframe.robot == k]
        at = np.array([keyframes[n].index for n in own_keys])
        corrections = np.stack([optimised[n] @ invert(poses[n]) for n in own_keys])
        trajectories[k] = _carried_along(T @ robots[k].estimates, at, corrections)
    return TeamEstimate(trajectories, len(found))


def fuse_team(
    backend: SlamBackend, robots: Sequence[RobotRun], estimate: TeamEstimate, every: int = 1
) -> SlamBackend:
    """Fuse the tracked frames of all robots into one map, at the server's poses.

    Denoising comes from the backend's fusion, which does not accept points seen in only one or two
    frames as surface. Returns the ``backend``.
    """
    backend.reset(next(iter(estimate.trajectories.values()))[0])
    for k, poses in estimate.trajectories.items():
        for index in np.flatnonzero(robots[k].tracked)[::every]:
            backend.fuse(robots[k].frames[index], poses[index])
    return backend


def _keyframes(number: int, robot: RobotRun, T: Float64, count: int) -> list[_Keyframe]:
    K = robot.backend.intrinsics
    return [
        _Keyframe(number, index, T @ robot.estimates[index], _cloud(robot.frames[index], K))
        for index in query_frames(robot, count)
    ]


def _cloud(frame: RGBDFrame, K: Intrinsics) -> Float64:
    """Points (M, 3) of a frame in the camera frame."""
    near = (frame.depth > 0) & (frame.depth < _FAR_M)
    points = K.rays()[near] * frame.depth[near][:, None]
    return voxel_downsample(points, _VOXEL_M) if len(points) else points


def _motion(a: int, b: int, keyframes: Sequence[_Keyframe], drift: float) -> Edge:
    """SLAM's estimate of the motion between neighbouring keyframes of a robot."""
    T = invert(keyframes[a].T_world_camera) @ keyframes[b].T_world_camera
    metres, angle = float(np.linalg.norm(T[:3, 3])), relative_angle(np.eye(3), T[:3, :3])
    return Edge(a, b, T, _SURE + drift * angle, _SURE + drift * metres)


def _links(
    keyframes: Sequence[_Keyframe], maps: Mapping[int, Float64], config: ServerConfig
) -> list[Edge]:
    """Relative poses of two robots' keyframes, one registered in the other's map."""
    found = []
    for b, seen in enumerate(keyframes):
        for robot, points in maps.items():
            if robot == seen.robot:
                continue
            T = _registered(seen, points, config)
            if T is not None:
                a = _nearest(T, keyframes, robot)
                motion = invert(keyframes[a].T_world_camera) @ T
                found.append(Edge(a, b, motion, MATCH_RAD, MATCH_M))
    return found


def _registered(seen: _Keyframe, points: Float64, config: ServerConfig) -> Float64 | None:
    """Register a keyframe with a map (M, 3); return T_world_camera (4, 4) if it fits nearby."""
    moved = transform_points(seen.T_world_camera, seen.cloud)
    if len(moved) < _FEWEST:
        return None
    low, high = moved.min(axis=0) - AGREE_M, moved.max(axis=0) + AGREE_M
    around = points[((points > low) & (points < high)).all(axis=1)]
    if len(around) < _FEWEST:
        return None
    fit = register_clouds(moved, around, "gicp", config.cutoff_m, _MATCHED)
    T = fit.T_target_source @ seen.T_world_camera
    near = fit.share >= LEAST_SHARE and _agree(T, seen.T_world_camera)
    return T if near else None


def _nearest(T: Float64, keyframes: Sequence[_Keyframe], robot: int) -> int:
    """A robot's keyframe nearest to a pose (4, 4)."""
    own = [k for k, keyframe in enumerate(keyframes) if keyframe.robot == robot]
    away = [np.linalg.norm(se3_log(invert(keyframes[k].T_world_camera) @ T)) for k in own]
    return own[int(np.argmin(away))]


def _agree(T: Float64, expected: Float64) -> bool:
    off = invert(expected) @ T
    turned = np.degrees(relative_angle(np.eye(3), off[:3, :3]))
    return bool(np.linalg.norm(off[:3, 3]) <= AGREE_M and turned <= AGREE_DEG)


def _carried_along(poses: Float64, at: Int64, corrections: Float64) -> Float64:
    """Move poses (N, 4, 4) with the keyframes ``at`` (K,), interpolating in between."""
    moved = np.empty_like(poses)
    for k, pose in enumerate(poses):
        after = int(np.clip(np.searchsorted(at, k, side="right"), 1, max(1, len(at) - 1)))
        if len(at) == 1:
            moved[k] = corrections[0] @ pose
            continue
        share = np.clip((k - at[after - 1]) / (at[after] - at[after - 1]), 0.0, 1.0)
        twist = se3_log(invert(corrections[after - 1]) @ corrections[after])
        moved[k] = corrections[after - 1] @ se3_exp(share * twist) @ pose
    return moved
