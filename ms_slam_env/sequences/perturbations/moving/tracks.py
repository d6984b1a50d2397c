"""The way of a moving object: round and round, or along a lane and again from its start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

Float64 = NDArray[np.float64]

_SPACING_M = 0.02


@dataclass(frozen=True)
class Track:
    """A way with its pace.

    Attributes:
        points: (M, 3) positions, densely spaced; of a closed way the last is the first again.
        yaws: (M,) heading at the points, radians, without jumps; of a closed way the last differs
            from the first by whole turns.
        times_s: (M,) when the points are reached, from 0.
        way_m: (M,) how far it is to them.
    """

    points: Float64
    yaws: Float64
    times_s: Float64
    way_m: Float64

    @property
    def period_s(self) -> float:
        """Time of one round."""
        return float(self.times_s[-1])

    def at(self, clock_s: ArrayLike) -> tuple[Float64, Float64, Float64]:
        """Positions (..., 3), headings (...) and ways (...) at times (...), rounds included."""
        clock = np.asarray(clock_s, dtype=np.float64)
        rounds = np.floor(clock / self.period_s)
        t = clock - rounds * self.period_s
        points = np.stack([np.interp(t, self.times_s, self.points[:, k]) for k in range(3)], -1)
        yaws = np.interp(t, self.times_s, self.yaws)
        return points, yaws, np.interp(t, self.times_s, self.way_m) + rounds * self.way_m[-1]


def round_track(
    start: Float64, end: Float64, half_width_m: float, speed_m_s: float, turn_rad_s: float
) -> Track:
    """There and back between two points (3,), on two lanes, turning at the ends.

    Args:
        start: middle of one turn.
        end: middle of the other.
        half_width_m: of the way; the lanes lie so far from the line between the points.
        speed_m_s: largest speed.
        turn_rad_s: largest speed of turning.
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
    """From one point (3,) straight to another, and again from the first."""
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
