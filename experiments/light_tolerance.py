"""Kullback-Leibler or earth mover's distance: which one mistakes a change of light for motion?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ms_slam_experiments.difficulty_errors import HISTOGRAMS

from ms_slam_env._runtime.threads import limit_threads
from ms_slam_env.benchmark.episodes import seed_list
from ms_slam_env.benchmark.experiment import Experiment
from ms_slam_env.camera import RGBDFrame, xtion
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.evaluation.sequence_divergence import consecutive_divergences
from ms_slam_env.report.tables import Grouping, Row, Table, flattened
from ms_slam_env.scenes import PUBLISHED_ROOMS
from ms_slam_env.sequences import HandheldPath, open_sequence

GAMMA = 2.2


@dataclass(frozen=True)
class LightSpec:
    """A sequence and the changes of its light; see :class:`LightTolerance` for the fields."""

    sequence: str
    gains: tuple[float, ...]
    offsets: tuple[float, ...]
    frames: int
    every: int


@dataclass(frozen=True)
class LightTolerance(Experiment, Checked):
    """Divergence of a change of light in units of that of a motion

    The paper expects the earth mover's distance to give "tolerance to small illumination changes".
    Each frame is compared with itself in other light (exposure: linear light times a gain; a lamp:
    grey levels plus an offset), and with the frame before in the same light. Below 100 %, the
    change of light has a smaller effect than the median motion.
    """

    scenes: tuple[str, ...] = PUBLISHED_ROOMS
    """Names of scenes."""
    gains: tuple[float, ...] = (1.02, 1.05, 1.1, 1.3)
    """Factors of the exposure."""
    offsets: tuple[float, ...] = (2.0, 5.0, 10.0)
    """Grey levels to add."""
    frames: int = bounded(60, 2, 100_000)
    """Number of frames of each path, at 30 Hz."""
    every: int = bounded(1, 1, 1000)
    """Take every n-th frame of it."""
    seeds: str = "validation"
    """Split that the seeds come from: train, validation or test; or your own, as 7000-7003."""

    unit = "sequences"

    def specs(self) -> list[LightSpec]:
        """One spec per scene.

        Raises:
            InputError: a gain that is not positive, or nothing that changes the light.
        """
        if not all(gain > 0 for gain in self.gains) or not (self.gains or self.offsets):
            raise InputError(f"gains {self.gains} must be > 0, and there must be gains or offsets")
        seed = seed_list(self.seeds, 1)[0]
        return self.each(LightSpec, sequence=[f"{scene}:{seed}" for scene in self.scenes])

    @staticmethod
    def run(spec: LightSpec) -> dict[str, Any]:
        """Compare every frame with the one before, and with itself in other light."""
        limit_threads(1)
        K = xtion("160x120")
        path = HandheldPath(spec.frames)
        frames = list(open_sequence(spec.sequence, "160x120", path=path).frames)[:: spec.every]
        configs = list(HISTOGRAMS.values())
        moved = np.median(consecutive_divergences(frames, K, configs)[..., 0], axis=0)
        changes = [
            *((f"exposure x {gain:g}", gain, 0.0) for gain in spec.gains),
            *((f"lamp + {offset:g}", 1.0, offset) for offset in spec.offsets),
        ]
        lines = []
        for name, gain, offset in changes:
            pairs = [
                consecutive_divergences([frame, relit(frame, gain, offset)], K, configs)[0, :, 0]
                for frame in frames
            ]
            lit = np.median(pairs, axis=0)
            lines += [
                {"light": name, "measure": measure, "light_to_motion": float(lit[k] / moved[k])}
                for k, measure in enumerate(HISTOGRAMS)
            ]
        return {"frames": len(frames), "lights": lines}

    def tables(self, rows: Sequence[Row]) -> list[Table]:
        """Medians over the scenes."""
        grouping = Grouping(("light", "measure"), ("light_to_motion",))
        return [grouping.table(flattened(rows, "lights"), note="Medians over the scenes.")]


def relit(frame: RGBDFrame, gain: float, offset: float) -> RGBDFrame:
    """The frame with its linear light multiplied by ``gain``, plus ``offset`` grey levels."""
    shade = 255.0 * np.clip(gain * (frame.color / 255.0) ** GAMMA, 0, 1) ** (1 / GAMMA)
    color = np.clip(np.round(shade + offset), 0, 255).astype(np.uint8)
    return replace(frame, color=color)
