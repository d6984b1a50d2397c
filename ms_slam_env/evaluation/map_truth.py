"""The true surface that a map is compared with, the same for every planner in one episode.

Precision asks whether each map point lies on the true surface, anywhere in the scene. Recall and
completeness ask how much of a *reference* was mapped. The reference must not depend on where a
planner went: measured against what it saw itself, a camera that stands still would be complete. The
reference is therefore the surface visible from places that the camera can reach: with `nearby`, on
a straight line of at most ``REACH_M`` from the start; with `scene`, anywhere in the scene; with
`arm`, where the arm can bring it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy import ndimage

from ms_slam_env._runtime.arrays import Bool, Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert, transform_points
from ms_slam_env.geometry.point_clouds import IndexedCloud
from ms_slam_env.robot import Embodiment
from ms_slam_env.robot.arm.arm import ArmEmbodiment, camera_poses
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor.scene_cache import get_scene

RADIUS_M = 3.0  # range of a view, in every direction; part of the protocol
REACH_M = 1.0
SURFACE_SPACING_M = 0.01  # half the smaller threshold of the F-score
REFERENCE_SPACING_M = 0.03
_VIEWPOINTS = 48
_CAMERA_RADIUS_M = 0.1
_OCCLUSION_SLACK = 0.01  # share of the distance by which a sample may lie behind the mesh
_GRID_M = 0.2  # spacing of camera positions in the whole scene; every third per axis looks around
_EVERY = 3


@lru_cache(maxsize=2)
def true_surface(scene: str, scene_seed: int, spacing_m: float = SURFACE_SPACING_M) -> IndexedCloud:
    """The scene's whole surface as points (N, 3), by default about 1 cm apart."""
    return IndexedCloud(get_scene(scene, scene_seed).surface_points(spacing_m)[0])


def reference_surface(
    kind: str, scene: Scene, start: Float64, embodiment: Embodiment, intrinsics: Intrinsics
) -> Float64:
    """Points (N, 3) of the true surface that a map should cover, by a task's kind of reference.

    Args:
        kind: ``nearby``, ``scene`` or ``arm``; see :class:`ms_slam_env.tasks.Task`.
        scene: scene to map.
        start: (3,) start position of the camera.
        embodiment: embodiment that moves the camera.
        intrinsics: of the camera.

    Raises:
        InputError: kind ``arm`` without an arm.
    """
    if kind == "nearby":
        return surface_nearby(scene, start)
    if kind == "scene":
        return surface_of_scene(scene, start)
    if not isinstance(embodiment, ArmEmbodiment):
        raise InputError("a task with reference 'arm' needs embodiment 'arm' or 'arm-kinematic'")
    return surface_of_views(scene, camera_poses(embodiment), intrinsics)


def surface_nearby(scene: Scene, start: Float64) -> Float64:
    """Points (N, 3) of the true surface that a camera starting at ``start`` (3,) could map nearby.

    All lie within ``RADIUS_M`` of the start.
    """
    points = scene.surface_points(REFERENCE_SPACING_M)[0]
    points = points[np.linalg.norm(points - start, axis=1) <= RADIUS_M]
    return _in_sight(scene, points, reachable_viewpoints(scene, start), lambda *_: True)


def surface_of_scene(scene: Scene, start: Float64) -> Float64:
    """Points (N, 3) of the true surface that a camera starting at ``start`` (3,) could map at all.

    Each lies within ``RADIUS_M`` of a position from which it is visible.
    """
    points = scene.surface_points(REFERENCE_SPACING_M)[0]
    eyes = connected_viewpoints(scene, start)
    return _in_sight(scene, points, eyes, lambda k, of: _is_near(of, eyes[k]))


def surface_of_views(scene: Scene, poses: Float64, intrinsics: Intrinsics) -> Float64:
    """Points (N, 3) of the true surface that a camera could map from ``poses`` (K, 4, 4).

    Each lies within ``RADIUS_M`` of a pose from which it is visible.
    """
    points = scene.surface_points(REFERENCE_SPACING_M)[0]
    half = np.array([intrinsics.width, intrinsics.height]) / 2
    middle = intrinsics.cx, intrinsics.cy
    eyes = poses[:, :3, 3]

    def is_in_view(k: int, of: Float64) -> Bool:
        local = transform_points(invert(poses[k]), of)
        ahead = local[:, 2] > 0
        local[~ahead] = (0, 0, 1)
        inside = (np.abs(intrinsics.project(local) - middle) <= half).all(axis=1)
        return ahead & inside & _is_near(of, eyes[k])

    return _in_sight(scene, points, eyes, is_in_view)


def _is_near(points: Float64, eye: Float64) -> Bool:
    return np.asarray(np.linalg.norm(points - eye, axis=1) <= RADIUS_M)


def _in_sight(
    scene: Scene, points: Float64, eyes: Float64, looked_at: Callable[[int, Float64], Bool | bool]
) -> Float64:
    """Those of ``points`` (N, 3) that are visible from at least one of the ``eyes`` (K, 3).

    Eye k considers only the points selected by ``looked_at(k, points)``.
    """
    caster = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    visible = np.zeros(len(points), dtype=bool)
    for k, eye in enumerate(eyes):
        hidden = np.flatnonzero(~visible)
        hidden = hidden[np.broadcast_to(looked_at(k, points[hidden]), hidden.shape)]
        directions = points[hidden] - eye
        # Distances are in units of the direction's length: 1 is the point itself.
        hit, _ = caster.first_hit(np.broadcast_to(eye, directions.shape), directions)
        visible[hidden[hit >= 1 - _OCCLUSION_SLACK]] = True
    return points[visible]


def reachable_viewpoints(scene: Scene, start: Float64) -> Float64:
    """(K, 3) camera positions along free straight lines from ``start``, which comes first."""
    rng = np.random.default_rng(0)  # fixed: the reference must not vary
    directions = rng.normal(size=(_VIEWPOINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = REACH_M * np.cbrt(rng.uniform(size=(_VIEWPOINTS, 1)))  # uniform in the ball
    ends = start + lengths * directions
    free = [end for end in ends if scene.segment_is_free(start, end, _CAMERA_RADIUS_M)]
    return np.array([start, *free])


def connected_viewpoints(scene: Scene, start: Float64) -> Float64:
    """(K, 3) camera positions all over the free space around ``start``, which comes first."""
    low, high = scene.bounds()
    first = np.floor((start - low) / _GRID_M)
    low = start - _GRID_M * first  # the start is a point of the grid
    shape = tuple((np.floor((high - low) / _GRID_M) + 1).astype(int))
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    free = scene.clearance(low + _GRID_M * cells) >= _CAMERA_RADIUS_M
    here = tuple(first.astype(int))
    space = free.reshape(shape)
    space[here] = True
    parts, _ = ndimage.label(space)
    chosen = (parts == parts[here]).ravel() & ((cells - first) % _EVERY == 0).all(axis=1)
    return np.concatenate([start[None], low + _GRID_M * cells[chosen]])
