"""The duplicate-object check: does a map of a rendered scene show an object twice?"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.evaluation.map_truth import SURFACE_SPACING_M
from ms_slam_env.geometry.point_clouds import voxel_firsts
from ms_slam_env.metrics.consistency import (
    ConsistencyRule,
    LabelledView,
    MapConsistency,
    ObjectConsistency,
    count_votes,
    distinct_placements,
    judge_consistency,
)
from ms_slam_env.scenes.mesh_queries import sample_surface
from ms_slam_env.sensor import RGBDSensor
from ms_slam_env.sensor.scene_cache import get_scene

MAP_VOXEL_M = 0.01


@dataclass(frozen=True)
class JudgedMap:
    """A map and the verdict on it.

    Attributes:
        points: (N, 3) of the map that were judged, world frame.
        colors: (N, 3) uint8, theirs.
        consistency: the verdict.
        labels: names of the scene's objects.
    """

    points: Float64
    colors: NDArray[np.uint8]
    consistency: MapConsistency
    labels: tuple[str, ...]

    def name(self, item: ObjectConsistency) -> str:
        """Name of an object."""
        return self.labels[item.label]

    def verdict(self) -> dict[str, Any]:
        """Metrics: ``success``, ``objects`` (judged), ``worst_apart_share``, ``duplicated``."""
        found = self.consistency
        return {
            "success": found.success,
            "objects": len(found.objects),
            "worst_apart_share": max((o.apart_share for o in found.objects), default=math.nan),
            "duplicated": [
                {"object": self.name(item), "apart_share": item.apart_share}
                for item in found.duplicated
            ],
        }


def labelled_view(
    sensor: RGBDSensor, T_world_camera: Float64, T_world_camera_estimate: Float64
) -> LabelledView:
    """What a frame from a true pose (4, 4) showed, for SLAM that put it at an estimated one."""
    view = sensor.ground_truth(T_world_camera)
    return LabelledView(
        T_world_camera, T_world_camera_estimate, view.color, view.depth, view.labels
    )


def judge_map(
    map_points: ArrayLike,
    map_colors: ArrayLike,
    views: list[LabelledView],
    sensor: RGBDSensor,
    rule: ConsistencyRule | None = None,
) -> JudgedMap:
    """Judge a map, points (N, 3) and colours (N, 3), made of ``views`` of the sensor's scene.

    An empty map shows nothing twice.
    """
    rule = rule or ConsistencyRule()
    scene = sensor.scene
    labels = scene.mesh.labels
    if len(np.asarray(map_points)) == 0:
        nothing = MapConsistency((), np.zeros(0, dtype=bool))
        return JudgedMap(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), nothing, labels)
    kept = voxel_firsts(map_points, MAP_VOXEL_M)
    points, colors = np.asarray(map_points)[kept], np.asarray(map_colors)[kept]
    votes = count_votes(points, colors, views, sensor.intrinsics, len(labels))
    surface, owner = labelled_surface(scene.name, scene.seed)
    placements = distinct_placements(views, points, rule.apart_m / 2)
    verdict = judge_consistency(points, votes, surface, owner, rule, placements)
    return JudgedMap(points, colors, verdict, labels)


@lru_cache(maxsize=2)
def labelled_surface(scene: str, seed: int) -> tuple[Float64, NDArray[np.int32]]:
    """The whole surface of a scene: points (N, 3) and the object (N,) of each.

    Also what ``Scene.surface_points`` leaves out as hidden: cameras do see into the narrow places
    that it takes for closed, and to a seat's inner side.
    """
    mesh = get_scene(scene, seed).mesh
    points, face = sample_surface(mesh.vertices, mesh.faces, SURFACE_SPACING_M)
    return points, mesh.face_label[face]
