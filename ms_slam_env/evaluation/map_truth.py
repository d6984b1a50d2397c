"""The true surface that a map is judged against, the same for every planner of one episode.

Precision asks of each map point whether it lies on the true surface, anywhere in the scene.
Recall and completeness ask how much of a *reference* was mapped. The reference must not depend on
where a planner went: measured against what it has seen itself, a camera that stands still is
complete. It is therefore all true surface within ``RADIUS_M`` of the start that can be seen from
some place that the camera can reach on a straight way of at most ``REACH_M``.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.base import Scene
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.sensor.scene_cache import get_scene

Float64 = NDArray[np.float64]

RADIUS_M = 3.0  # what a first view reaches, in every direction; part of the protocol
REACH_M = 1.0
SURFACE_SPACING_M = 0.01  # half the smaller threshold of the F-score
REFERENCE_SPACING_M = 0.03
_VIEWPOINTS = 48
_CAMERA_RADIUS_M = 0.1
_OCCLUSION_SLACK = 0.01  # share of the distance by which a sample may lie behind the mesh


@lru_cache(maxsize=2)
def true_surface(scene: str, scene_seed: int) -> Float64:
    """The scene's whole surface as points (N, 3) about 1 cm apart."""
    return get_scene(scene, scene_seed).surface_points(SURFACE_SPACING_M)[0]


@lru_cache(maxsize=2)
def reference_of(scene: str, scene_seed: int, start: tuple[float, float, float]) -> Float64:
    """The reference of a scene by name; planners of one episode follow each other."""
    return reference_surface(get_scene(scene, scene_seed), np.array(start))


def reference_surface(scene: Scene, start: Float64) -> Float64:
    """Points (N, 3) of true surface that a planner starting at ``start`` (3,) could map."""
    points = scene.surface_points(REFERENCE_SPACING_M)[0]
    points = points[np.linalg.norm(points - start, axis=1) <= RADIUS_M]
    caster = RayCaster(scene.mesh.vertices, scene.mesh.faces)
    visible = np.zeros(len(points), dtype=bool)
    for viewpoint in reachable_viewpoints(scene, start):
        hidden = np.flatnonzero(~visible)
        directions = points[hidden] - viewpoint
        # Distances come in units of the direction's length: 1 is the point itself.
        hit, _ = caster.first_hit(np.broadcast_to(viewpoint, directions.shape), directions)
        visible[hidden[hit >= 1 - _OCCLUSION_SLACK]] = True
    return points[visible]


def reachable_viewpoints(scene: Scene, start: Float64) -> Float64:
    """(K, 3) camera positions spread over the free straight ways from ``start``, itself first."""
    rng = np.random.default_rng(0)  # fixed: the reference must not vary
    directions = rng.normal(size=(_VIEWPOINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = REACH_M * np.cbrt(rng.uniform(size=(_VIEWPOINTS, 1)))  # uniform in the ball
    ends = start + lengths * directions
    free = [end for end in ends if scene.segment_is_free(start, end, _CAMERA_RADIUS_M)]
    return np.array([start, *free])
