"""Words for why something cannot be at a place of a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.scenes.base import Scene

Float64 = NDArray[np.float64]

_FLOOR = "floor"
_MET_M = 0.02  # closer than this to a surface is on it


def words(position: Float64) -> str:
    """A position (3,) to the millimetre."""
    return str(np.round(position, 3).tolist())


def floor_height(scene: Scene) -> float:
    """Height of the floor: of what has that label, of the lowest surface where nothing has."""
    mesh = scene.mesh
    if _FLOOR not in mesh.labels:
        return float(scene.bounds()[0][2])
    floor = mesh.faces[mesh.face_label == mesh.labels.index(_FLOOR)]
    return float(mesh.vertices[floor.ravel(), 2].min())


def outside(scene: Scene, position: Float64) -> str:
    """How a position (3,) lies outside the box around a scene's surfaces; empty if inside."""
    low, high = scene.bounds()
    low[2] = floor_height(scene)  # leaves of plants may reach through it
    if ((position >= low - _MET_M) & (position <= high + _MET_M)).all():
        return ""
    low, high = (np.round(corner, 2) + 0.0 for corner in (low, high))  # no minus before a zero
    aside = (position[:2] < low[:2] - _MET_M) | (position[:2] > high[:2] + _MET_M)
    if position[2] < low[2] and not aside.any():
        return f"below the floor of scene {scene.name}, which is at z = {low[2]:.2f} m"
    extent = " x ".join(f"{a:.2f} to {b:.2f}" for a, b in zip(low, high, strict=True))
    return f"outside scene {scene.name}, which spans {extent} m"


def enclosed(scene: Scene, position: Float64) -> str:
    """How a position (3,) is in no free space: outside a scene or in something; empty if free."""
    if scene.clearance(position[None])[0] > 0:
        return ""
    return outside(scene, position) or f"inside something in scene {scene.name}"
