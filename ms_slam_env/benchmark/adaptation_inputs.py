"""Sequences with quiet and violent stretches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import xtion
from ms_slam_env.config import check_range
from ms_slam_env.sensor.scene_cache import get_scene
from ms_slam_env.sequences import HandheldPath, RenderedSequence, render_sequence
from ms_slam_env.sequences.pose_interpolation import PoseInterpolation

Float64 = NDArray[np.float64]

_RAMP = 6  # frames over which the pace changes


@dataclass(frozen=True)
class Stretches:
    """A hand-held path, carried calmly and, now and then, in haste.

    Attributes:
        frames: length of the sequence.
        rate_hz: of the frames.
        speed_m_s: mean speed of the calm camera where it does not turn.
        turn_deg_s: mean speed of its rotation where it turns.
        quiet: frames of a calm stretch; the sequence begins with one.
        violent: frames of a hasty stretch after it.
        factor: how many times faster the same path is travelled in haste.

    Raises:
        InputError: a value out of range.
    """

    frames: int = 240
    rate_hz: float = 15.0
    speed_m_s: float = 0.1
    turn_deg_s: float = 7.5
    quiet: int = 75
    violent: int = 30
    factor: float = 20.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_range(self, "frames", 4, 100_000)
        check_range(self, "rate_hz", 0.1, 1000)
        check_range(self, "speed_m_s", 1e-3, 100)
        check_range(self, "turn_deg_s", 1e-2, 1e4)
        check_range(self, "quiet", 1, 100_000)
        check_range(self, "violent", 0, 100_000)
        check_range(self, "factor", 1, 1000)

    def pace(self) -> Float64:
        """(frames,) times faster than calm, with smooth changes."""
        place = np.arange(self.frames) % (self.quiet + self.violent)
        into = np.minimum(place - self.quiet + 1, self.quiet + self.violent - place) / _RAMP
        share = 0.5 * (1.0 - np.cos(np.pi * np.clip(into, 0.0, 1.0)))
        return 1.0 + (self.factor - 1.0) * share

    def is_violent(self) -> NDArray[np.bool_]:
        """(frames,) whether the pace is nearer to that of haste."""
        return self.pace() > 0.5 * (1.0 + self.factor)

    def render(self, scene_name: str, seed: int, image_size: str) -> RenderedSequence:
        """The sequence in a scene; ``seed`` is the scene's, the path's and the noise's."""
        scene = get_scene(scene_name, seed)
        progress = np.concatenate([[0.0], np.cumsum(self.pace()[1:])])  # in calm frames
        calm = HandheldPath(
            frames=math.ceil(progress[-1]) + 2,
            rate_hz=self.rate_hz,
            speed_m_s=self.speed_m_s,
            turn_deg_s=self.turn_deg_s,
        )
        path = PoseInterpolation(calm.timestamps, calm.poses(scene, seed))
        return render_sequence(
            scene,
            path(progress / self.rate_hz),
            xtion(image_size),
            seed=seed,
            timestamps=np.arange(self.frames) / self.rate_hz,
        )
