"""How good a map is: its points against the true surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env import metrics

Float64 = NDArray[np.float64]

THRESHOLDS_M = (0.02, 0.05)
MAP_VOXEL_M = 0.01  # a surface counts by its area, not by how often it was seen


def judge_map(points: Float64, surface: Float64, reference: Float64) -> dict[str, float]:
    """Map metrics from points (N, 3) of the map, of the true surface and of the reference."""
    result: dict[str, float] = {}
    if len(points):
        cloud = metrics.voxel_downsample(points, MAP_VOXEL_M)
        to_surface = metrics.nearest_distances(cloud, surface)
        to_map = metrics.nearest_distances(reference, cloud)
        rer = metrics.rer(cloud, surface)
    else:
        to_surface, to_map, rer = np.array([np.inf]), np.array([np.inf]), float("nan")
    for threshold in THRESHOLDS_M:
        name = f"{round(100 * threshold)}cm"
        precision = float((to_surface < threshold).mean())
        recall = float((to_map < threshold).mean())
        both = precision + recall
        result[f"precision_{name}"] = precision
        result[f"recall_{name}"] = recall
        result[f"f_score_{name}"] = 2 * precision * recall / both if both else 0.0
    return {**result, "rcm": result["recall_5cm"], "rer_m": rer, "map_points": len(points)}
