"""Camera paths that leave a place, do not see it for a long time, and return to it."""

from __future__ import annotations

import numpy as np

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.geometry import look_at
from ms_slam_env.scenes.scene import Scene
from ms_slam_env.sequences.paths import HandheldPath
from ms_slam_env.sequences.paths.camera_path import frame_times

HEIGHT_M = 1.3
CLEARANCE_M = 0.35  # free space kept around the camera
STARTS = 64  # places tried for the middle of a room
ORBITS_M = (0.9, 0.7, 0.5)
"""Radii of a path around an object; the first that fits is used."""
_OBJECT_M = 0.4  # radius around the path's axis in which the object lies
_ORBIT_CLEARANCE_M = 0.15
_LAPS_M = 0.06  # two laps are about 10 cm apart
_SWAY = ((0.382, 0.0), (0.618, 0.25))  # periods a lap, which no number of laps makes whole; phase
_ORBIT_GRID_M = 0.25
PATHS = ("around", "corridor", "handheld")
HANDHELD_FRAMES = 600
OVERLAP_TURNS = 0.3  # turns that a path continues after it has closed


def around_room(scene: Scene, seed: int, step_m: float = 0.02, step_deg: float = 1.5) -> Float64:
    """Poses (N, 4, 4) of a camera that moves in a circle in the freest place and looks outwards.

    It makes one turn and OVERLAP_TURNS more, so the first view returns after a whole turn.

    Args:
        scene: scene of the path.
        seed: seed of the initial direction, and of how the gaze moves up and down.
        step_m: largest translation from frame to frame.
        step_deg: largest rotation from frame to frame.

    Raises:
        InputError: there is no suitable place.
    """
    rng = np.random.default_rng([seed, 5])
    starts = np.stack([scene.sample_start(rng)[:3, 3] for _ in range(STARTS)])
    starts[:, 2] = HEIGHT_M
    clearance = scene.clearance(starts)
    centre, room = starts[clearance.argmax()], float(clearance.max())
    radius = min(0.6, room - CLEARANCE_M)
    if radius < 0.05:
        raise InputError(f"scene {scene.name!r}, seed {scene.seed}, has no room to walk around")
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.linspace(0, 1 + OVERLAP_TURNS, 1000)
    outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    waves = int(rng.integers(2, 5))
    gaze = outward + np.array([0, 0, -0.25])
    gaze[:, 2] += 0.2 * np.sin(waves * (angle - angle[0]))
    return _at_speed(centre + radius * outward, gaze, step_m, step_deg)


def along_corridor(scene: Scene, seed: int, step_m: float = 0.02, step_deg: float = 1.5) -> Float64:
    """Poses (N, 4, 4) that follow one wall of a corridor (x), turn, and come back along the other.

    At the end the camera turns to the first wall again and follows it for two metres.
    """
    rng = np.random.default_rng([seed, 6])
    low, high = (extreme(scene.surface_points(0.1)[0], axis=0) for extreme in (np.min, np.max))
    middle = float(low[1] + high[1]) / 2
    begin, end = float(low[0]) + 1.2, float(high[0]) - 1.2
    right, left = -np.radians(rng.uniform(50, 65)), np.radians(rng.uniform(50, 65))
    pitch = rng.uniform(-0.25, -0.1)
    # Place along the corridor, side, and yaw of the gaze (0 = along +x) at every corner.
    corners = np.array(
        [
            (begin, right),
            (end, right),
            (end, 0.0),
            (end, np.pi - left),
            (begin, np.pi - left),
            (begin, np.pi),
            (begin, 2 * np.pi + right),
            (begin + 2.0, 2 * np.pi + right),
        ]
    )
    s = np.linspace(0, len(corners) - 1, 200 * (len(corners) - 1) + 1)
    x, yaw = (np.interp(s, np.arange(len(corners)), column) for column in corners.T)
    sway = 0.1 * np.sin(1.3 * x + rng.uniform(0, 6))
    eyes = np.stack([x, middle + sway, HEIGHT_M + 0 * x], axis=1)
    gaze = np.stack([np.cos(yaw), np.sin(yaw), pitch + 0.1 * np.sin(2 * x)], axis=1)
    return _at_speed(eyes, gaze, step_m, step_deg)


def around_object(
    scene: Scene, seed: int, laps: int = 3, step_m: float = 0.04, step_deg: float = 3.0
) -> tuple[Float64, int]:
    """Poses (N, 4, 4) of a camera that orbits an object, and the number of frames of a lap.

    As in USME's relocalisation test, section 1.3 (2): "steadily around a textured object, a few
    times". Of the free circles, it uses the one around the most surface below the camera, and looks
    at that surface. It sways by `_LAPS_M` across and up, so that no lap repeats another: a hand
    would not either, and images that are alike to the last bit are found again too easily.

    Args:
        scene: scene of the path.
        seed: seed of the initial direction.
        laps: number of turns around the object.
        step_m: largest translation from frame to frame.
        step_deg: largest rotation from frame to frame.

    Raises:
        InputError: there is no object that the camera could orbit.
    """
    points = scene.surface_points(0.05)[0]
    low, high = points.min(axis=0), points.max(axis=0)
    below = points[(points[:, 2] > low[2] + 0.3) & (points[:, 2] < HEIGHT_M)]
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    best, centre, radius = 0, np.zeros(3), 0.0
    for x in np.arange(low[0], high[0], _ORBIT_GRID_M):
        for y in np.arange(low[1], high[1], _ORBIT_GRID_M):
            inside = int((np.hypot(*(below[:, :2] - [x, y]).T) < _OBJECT_M).sum())
            if inside <= best:
                continue
            middle = np.array([x, y, HEIGHT_M])
            for r in ORBITS_M:
                if scene.clearance(middle + r * circle).min() >= _ORBIT_CLEARANCE_M:
                    best, centre, radius = inside, middle, r
                    break
    if best == 0:
        raise InputError(f"scene {scene.name!r}, seed {scene.seed}, has nothing to go around")
    near = below[np.hypot(*(below[:, :2] - centre[:2]).T) < _OBJECT_M]
    target = np.array([*centre[:2], near[:, 2].mean()])
    begin = np.random.default_rng([seed, 8]).uniform(0, 2 * np.pi)
    turns = np.linspace(0, laps, 1000 * laps)
    angle = begin + 2 * np.pi * turns
    across, up = (_LAPS_M * np.sin(2 * np.pi * (rate * turns + phase)) for rate, phase in _SWAY)
    far = radius + across
    eyes = centre + np.stack([far * np.cos(angle), far * np.sin(angle), up], axis=1)
    poses = _at_speed(eyes, target - eyes, step_m, step_deg)
    return poses, len(poses) // laps


def _at_speed(eyes: Float64, gaze: Float64, step_m: float, step_deg: float) -> Float64:
    """Poses along densely sampled positions and directions (M, 3), as fast as the limits allow."""
    dense = np.stack([look_at(eye, eye + aim) for eye, aim in zip(eyes, gaze, strict=True)])
    frames = frame_times(dense, step_m, np.radians(step_deg))
    at = np.arange(0.0, frames[-1])
    columns = [np.interp(at, frames, column) for column in np.hstack([eyes, gaze]).T]
    return np.stack([look_at(row[:3], row[:3] + row[3:]) for row in np.stack(columns, axis=1)])


def returning_path(scene: Scene, path: str, seed: int, step_m: float, step_deg: float) -> Float64:
    """Poses (N, 4, 4) of a path named in `PATHS`; ``handheld`` is a closed hand-held loop.

    Raises:
        InputError: an unknown path, or none in this scene.
    """
    if path == "around":
        return around_room(scene, seed, step_m, step_deg)
    if path == "corridor":
        return along_corridor(scene, seed, step_m, step_deg)
    if path == "handheld":
        return HandheldPath(
            frames=HANDHELD_FRAMES, max_step_m=step_m, max_turn_deg=step_deg, loop=True
        ).poses(scene, seed)
    raise unknown("path", path, PATHS)
