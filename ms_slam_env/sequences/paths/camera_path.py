"""The interface of camera paths, and smooth curves through waypoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.geometry import look_at, relative_angle
from ms_slam_env.scenes.scene import Scene

_SAMPLES_PER_HOP = 40
_TREMOR_M = 0.002
_TREMOR_RATES = (0.05, 0.09, 0.13)  # cycles per frame


def unit(v: Float64) -> Float64:
    """Normalise a vector (3,)."""
    return v / np.linalg.norm(v)


def dense_path(
    eyes: Sequence[Float64], targets: Sequence[Float64], is_closed: bool = False
) -> Float64:
    """Poses (M, 4, 4), finely spaced, on splines through waypoints and viewing directions.

    Args:
        eyes: K waypoints (3,), metres.
        targets: K points (3,) that the camera looks at from the waypoints.
        is_closed: whether the path continues smoothly from the last waypoint to the first.
    """
    from scipy.interpolate import CubicSpline

    # Interpolates the viewing direction, not the target: two targets may be on opposite sides.
    directions = [unit(target - eye) for eye, target in zip(eyes, targets, strict=True)]
    if is_closed:
        eyes, directions = [*eyes, eyes[0]], [*directions, directions[0]]
    knots = np.arange(len(eyes), dtype=np.float64)
    s = np.linspace(0.0, knots[-1], _SAMPLES_PER_HOP * (len(knots) - 1) + 1)
    ends = "periodic" if is_closed else "not-a-knot"
    positions = CubicSpline(knots, np.stack(eyes), bc_type=ends)(s)
    aims = CubicSpline(knots, np.stack(directions), bc_type=ends)(s)
    return np.stack([look_at(eye, eye + aim) for eye, aim in zip(positions, aims, strict=True)])


def frame_times(path: Float64, speed_m: float, rot_rad: float) -> Float64:
    """Frame number (M,) at which each sample is reached if neither speed limit is exceeded."""
    travel = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1) / speed_m
    turn = [
        relative_angle(a, b) / rot_rad
        for a, b in zip(path[:-1, :3, :3], path[1:, :3, :3], strict=True)
    ]
    return np.concatenate([[0.0], np.cumsum(np.maximum(travel, turn))])


def resample(path: Float64, times: Float64, instants: NDArray, tremor: Float64) -> Float64:
    """Poses (N, 4, 4) at ``instants`` (N,), in the units of ``times`` (M,).

    Positions are shifted by ``tremor`` (N, 3) in metres, the point one metre ahead in the opposite
    direction.
    """
    at = np.asarray(instants, dtype=np.float64)
    eyes = np.stack([np.interp(at, times, path[:, k, 3]) for k in range(3)], axis=1)
    aims = np.stack([np.interp(at, times, path[:, k, 2]) for k in range(3)], axis=1)
    # Moving the eye differently from the point one metre ahead also shakes the direction.
    return np.stack(
        [look_at(eye + d, eye + aim - d) for eye, aim, d in zip(eyes, aims, tremor, strict=True)]
    )


def hand_tremor(frames: int, rng: np.random.Generator) -> Float64:
    """Hand tremor (frames, 3) in metres: three sines per axis."""
    t = np.arange(frames)[:, None]
    total = np.zeros((frames, 3))
    for rate in _TREMOR_RATES:
        phase = rng.uniform(0, 2 * np.pi, 3)
        amplitude = rng.uniform(0.2, 1.0, 3) * _TREMOR_M / len(_TREMOR_RATES)
        total += amplitude * np.sin(2 * np.pi * rate * t + phase)
    return total


class CameraPath(ABC):
    """A camera path through a scene: a frozen dataclass of its parameters."""

    @abstractmethod
    def motion(self, scene: Scene, seed: int) -> tuple[Float64, Float64]:
        """Times (N,) in seconds and poses T_world_camera (N, 4, 4).

        The same scene and seed give the same path.

        Raises:
            InputError: no free path, or one that the scene does not permit; if a loop is too short,
                the message says how many frames the shortest one needs.
        """

    def poses(self, scene: Scene, seed: int) -> Float64:
        """Only the poses of `motion`."""
        return self.motion(scene, seed)[1]
