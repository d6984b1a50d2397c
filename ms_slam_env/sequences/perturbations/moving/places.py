"""Where a moving object can go: ways through free space that a camera is likely to see."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.scenes.base import Scene
from ms_slam_env.scenes.mesh_queries import RayCaster
from ms_slam_env.scenes.movers import Shape
from ms_slam_env.sequences.perturbations.moving.tracks import (
    Track,
    round_track,
    straight_track,
)

Float64 = NDArray[np.float64]

_MARGIN_M = 0.03  # kept from the scene's surfaces
_FLAT_M = 0.06  # the ground may rise or fall by so much along a way, rugs and kerbs included
_TURN_RAD_S = np.radians(120.0)
_HALF_WIDTH_M = (0.08, 0.25)
_WAYS_A_PLACE = (4, 40)  # fewest and most; the more, the fewer places are free
_AROUND_M = 6.0  # of the camera: there floor and room are looked for
_SOUNDINGS = 400
_LANE_STEP_M = 0.25
_LONGEST_M = {"box": 1.5, "person": 3.0, "car": 40.0}  # from the middle of the way to its end
_SHORTEST_M = {"box": 0.25, "person": 0.25, "car": 2.0}
_DEPTHS_M = {"box": (0.9, 3.0), "person": (1.2, 6.0), "car": (4.0, 25.0)}


class Places:
    """Free ways of a shape in a scene, drawn where a camera looks."""

    def __init__(
        self, scene: Scene, camera: Float64, intrinsics: Intrinsics, rng: np.random.Generator
    ) -> None:
        """Take the poses (K, 4, 4) of the camera."""
        self._scene, self._camera, self._K, self._rng = scene, camera, intrinsics, rng
        self._rays = RayCaster(scene.mesh.vertices, scene.mesh.faces)
        self._ground_z = self._ground()

    def tracks(self, shape: Shape, speed_m_s: float, tries: int) -> Iterator[Track]:
        """Try ``tries`` ways; give those that are free."""
        if shape.kind == "car" and self._scene.lanes:
            for _ in range(tries):
                start, end = self._scene.lanes[int(self._rng.integers(len(self._scene.lanes)))]
                yield straight_track(np.asarray(start), np.asarray(end), speed_m_s)
            return
        draw = self._straight if shape.kind == "car" else self._round
        middles = self._points_in_view(shape.kind, tries)
        free = middles[self._are_free(shape, middles)]
        ways = int(np.clip(tries // max(len(free), 1), *_WAYS_A_PLACE))
        for middle in free:
            for _ in range(ways):
                track = draw(shape, middle, speed_m_s)
                if track is not None:
                    yield track

    def _ground(self) -> float:
        """Height of the floor: nearly the lowest of what lies beneath free places."""
        near = self._camera[:, :3, 3]
        places = np.concatenate([near, self._rng.uniform(*self._around(), (_SOUNDINGS, 3))])
        free = places[self._scene.clearance(places) > 0.1]
        reach, _ = self._rays.first_hit(free, np.broadcast_to([0.0, 0.0, -1.0], free.shape))
        heights = (free[:, 2] - reach)[np.isfinite(reach)]
        return float(np.percentile(heights, 5)) if len(heights) else 0.0

    def _around(self) -> tuple[Float64, Float64]:
        """Least and greatest corner (3,) of the scene, as far as it is near the camera's path."""
        low, high = self._scene.bounds()
        near = self._camera[:, :2, 3]
        low[:2] = np.maximum(low[:2], near.min(0) - _AROUND_M)
        high[:2] = np.minimum(high[:2], near.max(0) + _AROUND_M)
        return low, high

    def _points_in_view(self, kind: str, count: int) -> Float64:
        """Points (count, 3) in front of the camera's poses; of walkers and cars on the ground."""
        rng, K = self._rng, self._K
        T = self._camera[rng.integers(len(self._camera), size=count)]
        z = rng.uniform(*_DEPTHS_M[kind], count)
        x = (rng.uniform(0.1, 0.9, count) * K.width - K.cx) / K.fx
        y = (rng.uniform(0.2, 0.8, count) * K.height - K.cy) / K.fy
        local = np.stack([x * z, y * z, z], -1)
        points = np.einsum("kij,kj->ki", T[:, :3, :3], local) + T[:, :3, 3]
        if kind != "box":  # where there is little room it may also begin out of sight
            anywhere = count // 3
            points[:anywhere] = rng.uniform(*self._around(), (anywhere, 3))
            points[:, 2] = self._ground_z
        return points

    def _direction(self) -> Float64:
        angle = self._rng.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle), 0.0])

    def _round(self, shape: Shape, middle: Float64, speed_m_s: float) -> Track | None:
        """There and back along a free line."""
        rng, kind = self._rng, shape.kind
        along = self._direction()
        if kind == "box":
            along[2] = rng.uniform(-0.4, 0.4)
        along *= rng.uniform(_SHORTEST_M[kind], _LONGEST_M[kind])
        line = middle + np.linspace(-1.0, 1.0, 9)[:, None] * along
        if not self._are_free(shape, line).all():
            return None
        turning = np.inf if kind == "box" else _TURN_RAD_S
        half_width = rng.uniform(*_HALF_WIDTH_M)
        track = round_track(middle - along, middle + along, half_width, speed_m_s, turning)
        # Legs reach out ahead and behind, farther than the shape is wide.
        ahead = np.stack([np.cos(track.yaws), np.sin(track.yaws), np.zeros_like(track.yaws)], -1)
        reach = max(0.0, 0.5 * shape.length_m - shape.radius_m) * ahead
        points = np.concatenate([track.points + reach, track.points - reach])
        return track if self._are_free(shape, points[::4]).all() else None

    def _straight(self, shape: Shape, middle: Float64, speed_m_s: float) -> Track | None:
        """As far as the ground is free and level to both sides of a point."""
        along = self._direction()
        steps = np.arange(0.0, _LONGEST_M[shape.kind], _LANE_STEP_M)
        ends = []
        for sign in (-1.0, 1.0):
            is_free = self._are_free(shape, middle + sign * steps[:, None] * along)
            blocked = np.flatnonzero(~is_free)
            free = steps[: blocked[0]] if len(blocked) else steps
            if not len(free) or free[-1] < 0.5 * shape.length_m:
                return None
            ends.append(middle + sign * (free[-1] - 0.5 * shape.length_m) * along)
        if np.linalg.norm(ends[1] - ends[0]) < 2 * _SHORTEST_M[shape.kind]:
            return None
        return straight_track(ends[0], ends[1], speed_m_s)

    def _are_free(self, shape: Shape, points: Float64) -> NDArray[np.bool_]:
        """(N,) whether the shape on its way fits at points (N, 3)."""
        # A car goes straight, so only its width matters; the rest may turn.
        radius = (0.5 * shape.width_m if shape.kind == "car" else shape.radius_m) + _MARGIN_M
        if shape.kind == "box":
            return self._scene.clearance(points) > radius
        up = np.array([0.0, 0.0, 1.0])
        reach, _ = self._rays.first_hit(points + 0.3 * up, np.broadcast_to(-up, points.shape))
        is_free = np.abs(reach - 0.3) < _FLAT_M
        lowest = radius + 0.1  # the ground itself must not count
        for z in np.arange(lowest, max(shape.height_m - 0.5 * radius, lowest) + 0.01, 0.25):
            is_free &= self._scene.clearance(points + z * up) > radius
        return is_free
