"""Hand-held sequences with quiet and fast stretches, for what chooses among frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.benchmark.compare_inputs import Input, load, seen_surface
from ms_slam_env.camera import xtion
from ms_slam_env.config import check_range
from ms_slam_env.errors import InputError
from ms_slam_env.scenes.base import Scene
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import HandheldPath, render_sequence
from ms_slam_env.sequences.path_shape import hand_tremor, resample
from ms_slam_env.sequences.trajectories import free_path

Float64 = NDArray[np.float64]

RATE_HZ = 30.0
PACES = (0.1, 1.0, 4.0)
"""Nearly still, walking, in a hurry: multiples of ``HandheldPath``'s mean pace."""
_STRETCH_S = (0.8, 2.0)
_EASING_S = 0.25  # in which one pace gives way to the next
_VIEWS = 60  # of the true surface


@dataclass(frozen=True)
class UnevenPath:
    """A camera carried at 0.5 m/s or 30 deg/s, now and then ten times slower or four times faster.

    Attributes:
        frames: number of poses, 30 a second.
        speed_m_s: of the middle pace where it does not turn.
        turn_deg_s: of the middle pace where it turns.

    Raises:
        InputError: a value out of range.
    """

    frames: int = 300
    speed_m_s: float = 0.5
    turn_deg_s: float = 30.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "frames", 30, 100_000)
        check_range(self, "speed_m_s", 1e-3, 100.0)
        check_range(self, "turn_deg_s", 1e-2, 1e4)

    def paces(self, seed: int) -> Float64:
        """Pace (frames,) at each frame: stretches of 0.8 to 2 s, every pace once a round."""
        rng = np.random.default_rng([seed, 79])
        rates: list[float] = []
        while len(rates) < self.frames:
            for pace in rng.permutation(PACES):
                rates += [pace] * int(RATE_HZ * rng.uniform(*_STRETCH_S))
        width = int(_EASING_S * RATE_HZ)
        padded = np.concatenate([[rates[0]] * width, rates])
        return np.convolve(padded, np.ones(width) / width, "valid")[: self.frames]

    def poses(self, scene: Scene, seed: int) -> Float64:
        """T_world_camera (frames, 4, 4); the same scene and seed give the same path.

        Raises:
            InputError: no free path.
        """
        progress = np.concatenate([[0.0], np.cumsum(self.paces(seed)[1:])])
        rng = np.random.default_rng([seed, 80])
        tremor = hand_tremor(self.frames, rng)
        step_m, rot_rad = self.speed_m_s / RATE_HZ, np.radians(self.turn_deg_s) / RATE_HZ
        path, times = free_path(scene, float(progress[-1]), rng, step_m, rot_rad)
        return resample(path, times, progress, tremor)


def parse_uneven(sequence: str) -> tuple[str, int, bool]:
    """Scene, seed and whether the pace is steady, of ``scene:seed`` or ``scene:seed:steady``.

    Raises:
        InputError: something else. The scene is checked where it is made.
    """
    name, _, rest = sequence.partition(":")
    seed, _, pace = rest.partition(":")
    if not name or not seed.isdigit() or pace not in ("", "steady"):
        raise InputError(
            f"sequence {sequence!r} is neither a folder nor scene:seed or scene:seed:steady, such "
            "as living_room:2000"
        )
    return name, int(seed), pace == "steady"


def load_uneven(sequence: str, image_size: str, frames: int) -> Input:
    """The sequence of a name, with its truth.

    Args:
        sequence: ``scene:seed`` on an :class:`UnevenPath`, ``scene:seed:steady`` on a
            :class:`HandheldPath`, or the folder of a recording.
        image_size: such as 160x120.
        frames: of a rendered sequence.

    Raises:
        InputError: a sequence that cannot be made or read.
    """
    if Path(sequence).is_dir():
        return load(sequence, image_size, HandheldPath())
    name, seed, is_steady = parse_uneven(sequence)
    scene, intrinsics = get_scene(name, seed), xtion(image_size)
    path = HandheldPath(frames) if is_steady else UnevenPath(frames)
    poses = path.poses(scene, seed)
    rendered = render_sequence(scene, poses, intrinsics, "kinect", seed)
    picked = np.unique(np.linspace(0, frames - 1, _VIEWS).astype(np.int64))
    views = ((poses[k], rendered.frames.truth(int(k)).depth) for k in picked)
    surface = seen_surface(views, intrinsics)
    return Input(tuple(rendered.frames), poses, intrinsics, surface)
