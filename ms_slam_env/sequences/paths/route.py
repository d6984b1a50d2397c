"""Camera paths along streets and aisles, through named places of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import look_at
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences.paths.camera_path import (
    CameraPath,
    frame_times,
    hand_tremor,
    resample,
    unit,
)
from ms_slam_env.sequences.paths.wandering import RADIUS_M

_SAMPLE_M = 0.1
_CORNER_M = 0.9  # width of the filter that rounds corners
_AHEAD_M = 2.5  # distance along the path that the camera looks ahead
_OF_PASSAGE = (0.25, 1.2, 0.06)  # limits of these two and of straying, per width of a passage
_DOWN_DEG = 6.0  # mean angle of the view below the horizon, looking where one walks
_SWAY_DEG = 8.0  # amplitude of the view's sideways swing
_STRAY_M = 0.25  # sideways deviation of the path, so that a second pass differs from the first
_WAVES_M = (5.3, 11.9, 27.1)  # wavelengths of the sway along the path
_PACE_PERIODS = (23.0, 51.0, 117.0)  # in frames
_ATTEMPTS = 20


@dataclass(frozen=True)
class RoutePath(Checked, CameraPath):
    """A camera path along named places of a scene.

    The pace is always limited by one of the two speeds: the first along streets, the second around
    corners. The camera looks ahead and slightly down, swaying sideways. It does not keep a
    perfectly straight line: a second pass along a street runs slightly beside the first. Through
    passages as narrow as doors it stays in the middle.

    Attributes:
        via: names of places (``Scene.places``), or ``A-B`` for the midpoint of two.
        rate_hz: frame rate.
        speed_m_s: mean speed of the camera where it does not turn.
        turn_deg_s: mean angular speed where it turns.
        variation: share by which the pace varies up and down.
        height_m: height of the camera above the ground.

    Raises:
        InputError: a value out of range, or fewer than two places.
    """

    via: tuple[str, ...]
    rate_hz: float = bounded(10.0, 0.1, 10_000.0)
    speed_m_s: float = bounded(1.4, 1e-3, 100.0)
    turn_deg_s: float = bounded(25.0, 1e-2, 1e5)
    variation: float = bounded(0.2, 0.0, 0.9)
    height_m: float = bounded(1.6, 0.3, 3.0)

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        super().__post_init__()
        if len(self.via) < 2:
            raise InputError(f"RoutePath.via = {self.via!r} must name at least two places")

    def with_frames_scaled(self, scale: float) -> RoutePath:
        """The same path in ``scale`` times as many frames, at correspondingly lower speed."""
        return replace(self, speed_m_s=self.speed_m_s / scale, turn_deg_s=self.turn_deg_s / scale)

    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4).

        Raises:
            InputError: a scene without these places, or a path that is not free.
        """
        corners = _corners(scene, self.via)
        rng = np.random.default_rng([seed, 80])
        for _ in range(_ATTEMPTS):
            path = self._dense(corners, scene.passage_m, rng)
            if scene.clearance(path[:, :3, 3]).min() > RADIUS_M:
                return self._timed(path, rng)
        raise InputError(
            f"found no free way via {', '.join(self.via)} in scene {scene.name!r}, "
            f"seed {scene.seed}"
        )

    def _dense(self, corners: Float64, passage_m: float, rng: np.random.Generator) -> Float64:
        """Poses (M, 4, 4) every ``_SAMPLE_M``, without timing."""
        most = (_CORNER_M, _AHEAD_M, _STRAY_M)
        corner_m, ahead_m, stray_m = map(min, most, np.multiply(_OF_PASSAGE, passage_m).tolist())
        line = _rounded(corners, corner_m)
        arc: Float64 = _SAMPLE_M * np.arange(len(line), dtype=np.float64)
        ahead = np.minimum(np.arange(len(line)) + round(ahead_m / _SAMPLE_M), len(line) - 1)
        forward = line[ahead] - line
        last = int(np.argmax(ahead == len(line) - 1))
        forward[last:] = forward[last]
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        side = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(line))], -1)
        eyes = line + stray_m * _wave(arc, rng)[:, None] * side
        eyes[:, 2] += self.height_m + 0.05 * _wave(arc, rng)
        yaw = np.radians(_SWAY_DEG) * _wave(arc, rng)
        pitch = np.radians(-_DOWN_DEG + 2.0 * _wave(arc, rng))
        aims = np.cos(yaw)[:, None] * forward + np.sin(yaw)[:, None] * side
        aims = np.cos(pitch)[:, None] * aims + np.sin(pitch)[:, None] * np.array([0.0, 0.0, 1.0])
        return np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, aims, strict=True)])

    def _timed(self, path: Float64, rng: np.random.Generator) -> tuple[Float64, Float64]:
        turn_rad = np.radians(self.turn_deg_s) / self.rate_hz
        times = frame_times(path, self.speed_m_s / self.rate_hz, turn_rad)
        count = max(2, round(times[-1]) + 1)
        k = np.arange(count)[:, None]
        phase = rng.uniform(0, 2 * np.pi, len(_PACE_PERIODS))
        waves = np.sin(2 * np.pi * k / np.array(_PACE_PERIODS) + phase).mean(axis=1)
        progress = np.concatenate([[0.0], np.cumsum(1.0 + self.variation * waves[1:])])
        instants = progress / progress[-1] * times[-1]
        return k[:, 0] / self.rate_hz, resample(path, times, instants, hand_tremor(count, rng))


def _corners(scene: Scene, via: tuple[str, ...]) -> Float64:
    """Points (K, 3) of the named places."""
    places: dict[str, Float64] = getattr(scene, "places", {})
    if not places:
        raise InputError(f"scene {scene.name!r} has no named places for a route")
    points = []
    for name in via:
        ends = name.split("-")
        for end in ends:
            if end not in places:
                raise unknown(f"place of a route in scene {scene.name!r}", end, places)
        points.append(np.mean([places[end] for end in ends], axis=0))
    ways = [scene.way(a, b) for a, b in pairwise(points)]
    return np.concatenate([*(way[:-1] for way in ways), points[-1][None]])


def _rounded(corners: Float64, width_m: float) -> Float64:
    """Points (M, 3) about every ``_SAMPLE_M`` along the corners (K, 3), which are rounded."""
    from scipy.ndimage import gaussian_filter1d

    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    arc = np.arange(0.0, at[-1], _SAMPLE_M)
    line = np.stack([np.interp(arc, at, corners[:, k]) for k in range(3)], -1)
    # Extend both ends straight, because the filter would pull them inwards.
    margin = round(4 * width_m / _SAMPLE_M)
    steps = _SAMPLE_M * np.arange(1, margin + 1)[:, None]
    before = line[0] - steps[::-1] * unit(corners[1] - corners[0])
    after = line[-1] + steps * unit(corners[-1] - corners[-2])
    long = np.concatenate([before, line, after])
    return gaussian_filter1d(long, width_m / _SAMPLE_M, axis=0)[margin:-margin]


def _wave(arc: Float64, rng: np.random.Generator) -> Float64:
    """A smooth function (M,) of the arc length, within [-1, 1]."""
    phase = rng.uniform(0, 2 * np.pi, len(_WAVES_M))
    return np.sin(2 * np.pi * arc[:, None] / np.array(_WAVES_M) + phase).mean(axis=1)
