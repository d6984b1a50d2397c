"""Hand-held camera paths at a given pace: seeded, smooth, open or closed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import so3_exp
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences.paths.camera_path import (
    CameraPath,
    dense_path,
    frame_times,
    hand_tremor,
    resample,
    unit,
)
from ms_slam_env.sequences.paths.wandering import RADIUS_M, Gaze, free_path

_SAMPLES = 2000
_SPACING_M = 0.25  # between nodes of the roadmap
_REACH_M = 0.7  # largest length of an edge
_HEIGHT_M = 0.25  # largest height difference of nodes from the start
_DETOUR = 4.0  # cost factor of edges already used
_FEWEST_WAYPOINTS = 12  # with 30 degrees of the turn between two of them
_SWEEP_RAD = np.radians(45.0)  # largest deviation from the uniformly turning direction
_TURN_RAD = np.radians(70.0)  # largest angle between the viewing directions of two waypoints
_FARTHEST_M = 4.5
_DESTINATIONS = 120  # tried per start
_NEAR_M = 0.6  # destinations nearer than this are tried last
_STARTS = 5
_CLOSED_PATHS = 4  # to choose among, per start
_PACE_PERIODS_S = (2.3, 5.1, 11.7)


def _roadmap(
    scene: Scene, start: Float64, radius_m: float, rng: np.random.Generator
) -> tuple[Float64, Float64]:
    """Random free nodes (N, 3), and lengths (N, N) of free straight edges between them, 0 = none.

    The nodes are near the height of ``start`` (3,), which is the first.
    """
    from scipy.spatial import cKDTree

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
    return nodes, lengths


def _shortest(lengths: Float64, start: int, end: int) -> list[int]:
    """Nodes on the shortest route from ``start`` to ``end``, both included; empty if none."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    _, before = dijkstra(csr_array(lengths), indices=start, return_predecessors=True)
    way = [end]
    while way[-1] != start:
        if before[way[-1]] < 0:
            return []
        way.append(int(before[way[-1]]))
    return way[::-1]


def _round_trip(places: Float64, lengths: Float64, destination: int) -> list[Float64]:
    """Waypoints to a node and back, on another route if the detour is acceptable."""
    from scipy.spatial import cKDTree

    out = _shortest(lengths, 0, destination)
    if not out:
        return []
    costs = lengths.copy()
    taken = places[out[1:-1]]
    if len(taken):
        distance, _ = cKDTree(taken).query(places)
        is_near = distance < 2 * _SPACING_M
        costs[is_near] *= _DETOUR
        costs[:, is_near] *= _DETOUR
    back = _shortest(costs, destination, 0)
    eyes = [places[i] for i in [*out, *back[1:-1]]]
    while len(eyes) < _FEWEST_WAYPOINTS:  # halves every edge, for enough steps of the turn
        after = [*eyes[1:], eyes[0]]
        eyes = [p for a, b in zip(eyes, after, strict=True) for p in (a, 0.5 * (a + b))]
    return eyes


def _sweep(
    eyes: list[Float64], heading: Float64, gaze: Gaze, rng: np.random.Generator
) -> list[Float64] | None:
    """Targets to look at from each waypoint while turning once around; None if one fails."""
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

    Each leads to another place and turns the camera once around, so what is seen at the end was out
    of view most of the time. ``radius_m`` is the clearance of the waypoints; the splines between
    them keep half of it.
    """
    start = scene.sample_start(rng)
    places, lengths = _roadmap(scene, start[:3, 3], radius_m, rng)
    heading = unit(start[:3, 2] * (1.0, 1.0, 0.0))
    gaze = Gaze(scene)
    distance = np.linalg.norm(places - places[0], axis=1)
    others = 1 + rng.permutation(len(distance) - 1)
    far_first = others[np.argsort(distance[others] < _NEAR_M, kind="stable")]
    for destination in far_first[:_DESTINATIONS]:
        eyes = _round_trip(places, lengths, int(destination))
        targets = _sweep(eyes, heading, gaze, rng) if eyes else None
        if targets is None:
            continue
        path = dense_path(eyes, targets, is_closed=True)
        if scene.clearance(path[:, :3, 3]).min() > 0.5 * radius_m:
            yield path


@dataclass(frozen=True)
class HandheldPath(Checked, CameraPath):
    """A hand-held camera path.

    The pace is always limited by one of the two speeds: the first on straight sections, the second
    in turns. It varies slowly about its mean.

    Attributes:
        frames: number of poses.
        rate_hz: frame rate.
        speed_m_s: mean speed of the camera where it does not turn.
        turn_deg_s: mean angular speed where it turns.
        variation: share by which the pace varies up and down.
        max_step_m: largest translation from frame to frame, without the tremor.
        max_turn_deg: largest rotation from frame to frame, without the tremor.
        loop: whether it returns to the start, turning once around and going back on another route
            if the scene has one. The path is then distributed evenly over the frames, in several
            rounds if there are many, and slower than the pace if necessary.
    """

    frames: int = bounded(300, 2, 1_000_000)
    rate_hz: float = bounded(30.0, 0.1, 10_000.0)
    speed_m_s: float = bounded(0.5, 1e-3, 100.0)
    turn_deg_s: float = bounded(30.0, 1e-2, 1e4)
    variation: float = bounded(0.3, 0.0, 0.9)
    max_step_m: float = bounded(0.04, 1e-4, 10.0)
    max_turn_deg: float = bounded(2.0, 1e-3, 180.0)
    loop: bool = False

    @property
    def timestamps(self) -> Float64:
        """(frames,) seconds."""
        return np.arange(self.frames) / self.rate_hz

    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """See the base class."""
        rng = np.random.default_rng([seed, 78])
        pace = self._pace(rng)
        tremor = hand_tremor(self.frames, rng)
        step_m = self.speed_m_s / self.rate_hz
        rot_rad = np.radians(self.turn_deg_s) / self.rate_hz
        if not self.loop:
            path, times = free_path(scene, float(pace[-1]), rng, step_m, rot_rad)
            return self.timestamps, resample(path, times, pace, tremor)
        path, times = self._closed(scene, float(pace[-1]), rng, step_m, rot_rad)
        rounds = max(1, int(pace[-1] / times[-1]))
        instants = (pace * rounds / pace[-1] % 1.0) * times[-1]
        instants[-1] = times[-1]  # the end of the last round
        return self.timestamps, resample(path, times, instants, tremor)

    def _pace(self, rng: np.random.Generator) -> Float64:
        """Progress (frames,) in frames at the mean pace; no step exceeds the limits."""
        t = self.timestamps[:, None]
        phase = rng.uniform(0, 2 * np.pi, len(_PACE_PERIODS_S))
        waves = np.sin(2 * np.pi * t / np.array(_PACE_PERIODS_S) + phase).mean(axis=1)
        limit = min(
            self.max_step_m * self.rate_hz / self.speed_m_s,
            self.max_turn_deg * self.rate_hz / self.turn_deg_s,
        )
        steps = np.minimum(1.0 + self.variation * waves, limit)
        return np.concatenate([[0.0], np.cumsum(steps[1:])])

    def _closed(
        self, scene: Scene, length: float, rng: np.random.Generator, step_m: float, rot_rad: float
    ) -> tuple[Float64, Float64]:
        """Find the longest closed path that takes at most ``length`` frames at the mean pace."""
        where = f"scene {scene.name!r}, seed {scene.seed}"
        shortest = 2 * np.pi / rot_rad  # the turn alone
        lengths: list[float] = []
        for _ in range(_STARTS if shortest <= length else 0):
            fitting: list[tuple[Float64, Float64]] = []
            for path in itertools.islice(closed_paths(scene, rng, RADIUS_M), _CLOSED_PATHS):
                times = frame_times(path, step_m, rot_rad)
                lengths.append(times[-1])
                if times[-1] <= length:
                    fitting.append((path, times))
            if fitting:
                return max(fitting, key=lambda found: found[1][-1])
        if shortest <= length and not lengths:
            raise InputError(f"found no closed path of a camera in {where}")
        raise InputError(
            f"a loop in {where} takes at least {min(lengths, default=shortest) + 1:.0f} frames at "
            f"this pace, not {self.frames}"
        )
