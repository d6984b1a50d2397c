"""Moving objects: their routes with speed, and their bodies at any time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.scenes.mesh_queries import LightProbe
from ms_slam_env.scenes.movers.shape import Joint, Shape
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sensor import Body

_SPACING_M = 0.02


_LIGHT_EVERY_M = 0.3
_MOST_PROBES = 40


@dataclass(frozen=True)
class Track:
    """A route with timing.

    Attributes:
        points: (M, 3) densely spaced positions; on a closed route the last equals the first.
        yaws: (M,) heading at the points, radians, without jumps; on a closed route the last differs
            from the first by whole turns.
        times_s: (M,) times at which the points are reached, from 0.
        way_m: (M,) distance travelled to the points.
    """

    points: Float64
    yaws: Float64
    times_s: Float64
    way_m: Float64

    @property
    def period_s(self) -> float:
        """Duration of one round."""
        return float(self.times_s[-1])

    def at(self, clock_s: ArrayLike) -> tuple[Float64, Float64, Float64]:
        """Positions (..., 3), headings (...), distances (...) at times (...), over all rounds."""
        clock = np.asarray(clock_s, dtype=np.float64)
        rounds = np.floor(clock / self.period_s)
        t = clock - rounds * self.period_s
        points = np.stack([np.interp(t, self.times_s, self.points[:, k]) for k in range(3)], -1)
        yaws = np.interp(t, self.times_s, self.yaws)
        return points, yaws, np.interp(t, self.times_s, self.way_m) + rounds * self.way_m[-1]


def round_track(
    start: Float64, end: Float64, half_width_m: float, speed_m_s: float, turn_rad_s: float
) -> Track:
    """Make a route back and forth between two points (3,), on two lanes, turning at the ends.

    Args:
        start: centre of one turn.
        end: centre of the other turn.
        half_width_m: distance of each lane from the line between the points.
        speed_m_s: largest speed.
        turn_rad_s: largest angular speed.
    """
    along = end - start
    ahead = np.array([along[0], along[1], 0.0])
    ahead /= np.linalg.norm(ahead)
    left = np.array([-ahead[1], ahead[0], 0.0]) * half_width_m
    back = ahead * half_width_m
    straight = np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(along) / half_width_m)))[:, None]
    bend = np.linspace(-np.pi / 2, np.pi / 2, 5)[1:-1, None]
    knots = np.concatenate(
        [
            start - left + straight * along,
            end + np.cos(bend) * back + np.sin(bend) * left,
            end + left - straight * along,
            start - np.cos(bend) * back - np.sin(bend) * left,
            (start - left)[None],
        ]
    )
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    spline = CubicSpline(steps, knots, bc_type="periodic")
    s = np.linspace(0.0, steps[-1], max(32, int(steps[-1] / _SPACING_M)))
    points, tangents = spline(s), spline(s, 1)
    yaws = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    return _paced(points, yaws, speed_m_s, turn_rad_s)


def straight_track(start: Float64, end: Float64, speed_m_s: float) -> Track:
    """Make a straight route from one point (3,) to another, repeated from the first."""
    along = end - start
    share = np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(along) / 0.25)))[:, None]
    yaws = np.full(len(share), np.arctan2(along[1], along[0]))
    return _paced(start + share * along, yaws, speed_m_s, np.inf)


def _paced(points: Float64, yaws: Float64, speed_m_s: float, turn_rad_s: float) -> Track:
    ways = np.linalg.norm(np.diff(points, axis=0), axis=1)
    times = np.maximum(ways / speed_m_s, np.abs(np.diff(yaws)) / turn_rad_s)
    zero = np.zeros(1)
    return Track(
        points,
        yaws,
        np.concatenate([zero, np.cumsum(times)]),
        np.concatenate([zero, np.cumsum(ways)]),
    )


class Mover:
    """One moving object.

    Its position depends on its clock, which starts at ``phase_s`` and runs with the frames' time;
    ``wait`` stops it for a while.

    Attributes:
        name: name of the object.
        shape: its shape.
        track: its route.
    """

    def __init__(
        self, name: str, shape: Shape, track: Track, phase_s: float, spin_rad_s: float = 0.0
    ) -> None:
        """Place it on its route; with ``spin_rad_s`` it spins instead of facing ahead."""
        self.name, self.shape, self.track = name, shape, track
        self._spin = spin_rad_s
        self._phase = phase_s
        self._waits: list[tuple[float, float]] = []  # (start, duration), in order

    def clock(self, times_s: ArrayLike) -> Float64:
        """Clock (...) at times (...), in seconds."""
        t = np.asarray(times_s, dtype=np.float64)
        clock = t + self._phase
        for start, duration in self._waits:
            clock = clock - np.clip(t - start, 0.0, duration)
        return clock

    def wait(self, start_s: float, duration_s: float) -> None:
        """Stand still for ``duration_s`` from ``start_s`` on; waits must come in order."""
        self._waits.append((float(start_s), float(duration_s)))

    def get_state(self) -> list[tuple[float, float]]:
        """The waits so far."""
        return list(self._waits)

    def set_state(self, waits: list[tuple[float, float]]) -> None:
        """Restore what ``get_state`` returned."""
        self._waits = [(float(time), float(length)) for time, length in waits]

    def pose(self, times_s: ArrayLike) -> Float64:
        """T_world_object (..., 4, 4) at times (...)."""
        T, _ = self._pose_and_way(times_s)
        return T

    def _pose_and_way(self, times_s: ArrayLike) -> tuple[Float64, Float64]:
        clock = self.clock(times_s)
        points, yaws, ways = self.track.at(clock)
        if self._spin:
            yaws = self._spin * clock
        T = np.zeros((*clock.shape, 4, 4))
        c, s = np.cos(yaws), np.sin(yaws)
        T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = c, -s, s, c
        T[..., 2, 2] = T[..., 3, 3] = 1.0
        T[..., :3, 3] = points
        return T, ways

    def middle(self, times_s: ArrayLike) -> Float64:
        """Centre (..., 3) of the object at times (...)."""
        points, _, _ = self.track.at(self.clock(times_s))
        height = 0.5 * (self.shape.height_m - self.shape.depth_m)
        return points + np.array([0.0, 0.0, height])

    @property
    def reach_m(self) -> float:
        """Radius of the enclosing ball about its centre."""
        half = 0.5 * (self.shape.height_m + self.shape.depth_m)
        return float(np.hypot(self.shape.radius_m, half))

    def distance(self, points: Float64, times_s: Float64) -> Float64:
        """Distance (N,) of points (N, 3) from the object's bounding box at times (N,)."""
        T = self.pose(times_s)
        local = np.einsum("nji,nj->ni", T[:, :3, :3], points - T[:, :3, 3])
        shape = self.shape
        high = np.array([0.5 * shape.length_m, 0.5 * shape.width_m, shape.height_m])
        low = np.array([-high[0], -high[1], -shape.depth_m])
        return np.linalg.norm(local - np.clip(local, low, high), axis=1)

    def outline(self, times_s: Float64) -> Float64:
        """Nine points (9, N, 3) of the object at times (N,): its centre, corners and sides."""
        T = self.pose(times_s)
        shape = self.shape
        z = 0.5 * (shape.height_m - shape.depth_m)
        x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
        local = np.stack(
            [0.5 * shape.length_m * x.ravel(), 0.5 * shape.width_m * y.ravel(), np.full(9, z)], -1
        )
        return np.swapaxes(local @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3], 0, 1)

    def bodies(self, probe: LightProbe) -> list[Body]:
        """The bodies that the sensor sees."""
        light = self._light(probe)
        return [
            Body(self.name, part.mesh, partial(self._part_pose, part.joint), light)
            for part in self.shape.parts
        ]

    def _part_pose(self, joint: Joint, times_s: Float64) -> Float64:
        T, ways = self._pose_and_way(times_s)
        return T @ joint.pose(ways)

    def _light(self, probe: LightProbe) -> Callable[[float], Float64]:
        """The light around the object at a time, interpolated between probes along its route."""
        track = self.track
        count = int(np.clip(track.way_m[-1] / _LIGHT_EVERY_M, 2, _MOST_PROBES))
        instants = np.linspace(0.0, track.period_s, count)
        height = 0.5 * (self.shape.height_m - self.shape.depth_m)
        lights = np.stack(
            [probe.around(point + np.array([0.0, 0.0, height])) for point in track.at(instants)[0]]
        ).reshape(count, 12)

        def light(time_s: float) -> Float64:
            clock = float(self.clock(time_s)) % track.period_s
            return np.array([np.interp(clock, instants, column) for column in lights.T]).reshape(
                4, 3
            )

        return light


def bodies_of(movers: Sequence[Mover], scene: Scene) -> list[Body]:
    """The bodies of moving objects, in the light of a scene."""
    if not movers:
        return []
    probe = LightProbe(scene.mesh)
    return [body for mover in movers for body in mover.bodies(probe)]
