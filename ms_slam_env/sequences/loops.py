"""Closed camera paths: out, all around, and back to the start by another way if there is one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ms_slam_env.geometry import so3_exp
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sequences.gaze import Gaze
from ms_slam_env.sequences.path_shape import dense_path, unit

Float64 = NDArray[np.float64]

_SAMPLES = 2000
_SPACING_M = 0.25  # between places of the roadmap
_REACH_M = 0.7  # between places that are joined
_HEIGHT_M = 0.25  # places lie so far above or below the start
_DETOUR = 4.0  # a way that was taken already counts as so many times its length
_FEWEST_WAYPOINTS = 12  # 30 degrees of the turn between two of them
_SWEEP_RAD = np.radians(45.0)  # off the evenly turning direction
_TURN_RAD = np.radians(70.0)  # between the viewing directions of two waypoints
_FARTHEST_M = 4.5
_DESTINATIONS = 120  # tried for one start
_NEAR_M = 0.6  # destinations nearer than this are tried last


@dataclass(frozen=True)
class _Roadmap:
    """Free places (N, 3), and the lengths (N, N) of the free straight ways between near ones."""

    places: Float64
    lengths: Float64  # 0 = no way


def _roadmap(scene: Scene, start: Float64, radius_m: float, rng: np.random.Generator) -> _Roadmap:
    """Random free places around the height of ``start`` (3,), which is the first of them."""
    low, high = scene.bounds()
    low[2], high[2] = start[2] - _HEIGHT_M, start[2] + _HEIGHT_M
    drawn = rng.uniform(low, high, (_SAMPLES, 3))
    places = [start]
    for place in drawn[scene.clearance(drawn) > radius_m]:
        if np.linalg.norm(np.stack(places) - place, axis=1).min() > _SPACING_M:
            places.append(place)
    nodes = np.stack(places)
    lengths = np.zeros((len(nodes), len(nodes)))
    for a, b in sorted(cKDTree(nodes).query_pairs(_REACH_M)):
        if scene.segment_is_free(nodes[a], nodes[b], radius_m):
            lengths[a, b] = lengths[b, a] = np.linalg.norm(nodes[a] - nodes[b])
    return _Roadmap(nodes, lengths)


def _shortest(lengths: Float64, start: int, end: int) -> list[int]:
    """Places from ``start`` to ``end``, both included; empty if there is no way."""
    _, before = dijkstra(csr_array(lengths), indices=start, return_predecessors=True)
    way = [end]
    while way[-1] != start:
        if before[way[-1]] < 0:
            return []
        way.append(int(before[way[-1]]))
    return way[::-1]


def _round_trip(roadmap: _Roadmap, destination: int) -> list[Float64]:
    """Waypoints to a place and back, by another way where the detour is bearable."""
    out = _shortest(roadmap.lengths, 0, destination)
    if not out:
        return []
    costs = roadmap.lengths.copy()
    taken = roadmap.places[out[1:-1]]
    if len(taken):
        distance, _ = cKDTree(taken).query(roadmap.places)
        is_near = distance < 2 * _SPACING_M
        costs[is_near] *= _DETOUR
        costs[:, is_near] *= _DETOUR
    back = _shortest(costs, destination, 0)
    eyes = [roadmap.places[i] for i in [*out, *back[1:-1]]]
    while len(eyes) < _FEWEST_WAYPOINTS:  # halves every way, so that the turn has its steps
        after = [*eyes[1:], eyes[0]]
        eyes = [p for a, b in zip(eyes, after, strict=True) for p in (a, 0.5 * (a + b))]
    return eyes


def _sweep(
    eyes: list[Float64], heading: Float64, gaze: Gaze, rng: np.random.Generator
) -> list[Float64] | None:
    """What to look at from each waypoint while turning once around; None if something fails."""
    side = rng.choice([-1.0, 1.0])
    targets: list[Float64] = []
    for k, eye in enumerate(eyes):
        turned = so3_exp([0.0, 0.0, side * 2 * np.pi * k / len(eyes)]) @ heading
        cones = [(turned, _SWEEP_RAD)]
        if targets:
            cones.append((unit(targets[-1] - eyes[k - 1]), _TURN_RAD))
        target = gaze.choose(eye, cones, rng, max(_FARTHEST_M, gaze.scene.gaze_m))
        if target is None:
            return None
        targets.append(target)
    return targets


def closed_paths(scene: Scene, rng: np.random.Generator, radius_m: float) -> Iterator[Float64]:
    """Dense closed paths (M, 4, 4) from one random start: the first pose equals the last.

    Each leads to another place and turns the camera once around on the way, so what the end sees
    was out of sight for most of it. ``radius_m`` is the free space around the waypoints; the
    splines between them keep half of it.
    """
    start = scene.sample_start(rng)
    roadmap = _roadmap(scene, start[:3, 3], radius_m, rng)
    heading = unit(start[:3, 2] * (1.0, 1.0, 0.0))
    gaze = Gaze(scene)
    distance = np.linalg.norm(roadmap.places - roadmap.places[0], axis=1)
    others = 1 + rng.permutation(len(distance) - 1)
    far_first = others[np.argsort(distance[others] < _NEAR_M, kind="stable")]
    for destination in far_first[:_DESTINATIONS]:
        eyes = _round_trip(roadmap, int(destination))
        targets = _sweep(eyes, heading, gaze, rng) if eyes else None
        if targets is None:
            continue
        path = dense_path(eyes, targets, is_closed=True)
        if scene.clearance(path[:, :3, 3]).min() > 0.5 * radius_m:
            yield path
