"""Evaluations that need no SLAM, for tests of explorations; importable by other processes."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.tuning import ExplorationSettings, SearchSpace, explore, make_space

PARAMETERS = ("depth_cutoff_m=1:9", "keyframe_deg=0:10", "keyframe_m=0:1")
"""Of the odometry backend, whose parameters are checked without loading kernels."""


@dataclass(frozen=True)
class FakeEvaluation:
    """Smooth error and time of the parameters; larger angles than ``lost_from`` lose track.

    Attributes:
        seconds: that an evaluation takes.
        lost_from: keyframe_deg from which on the evaluation fails.
        die: folder; the first evaluation of a depth cutoff above 5 m leaves a file there and kills
            its process.
        complain: the evaluation of a depth cutoff above 5 m raises this.
    """

    seconds: float = 0.0
    lost_from: float = 8.0
    die: str = ""
    complain: str = ""

    def __call__(self, configuration: SlamConfiguration) -> dict[str, Any]:
        time.sleep(self.seconds)
        params = configuration.slam_config
        if self.die and params["depth_cutoff_m"] > 5 and not (Path(self.die) / "died").exists():
            (Path(self.die) / "died").touch()
            os._exit(7)
        if self.complain and params["depth_cutoff_m"] > 5:
            raise (InputError if self.complain == "input" else TypeError)("no such sequence")
        return values(params, self.lost_from)


def values(params: dict[str, Any], lost_from: float = 8.0) -> dict[str, Any]:
    cutoff, angle, reach = (
        params[name] for name in ("depth_cutoff_m", "keyframe_deg", "keyframe_m")
    )
    measured = {
        "ate_m": 0.01 + 0.01 * (reach - 0.3) ** 2 + 0.05 / cutoff,
        "ext_ms": 2.0 + cutoff + 3.0 / (1.0 + angle),
        "M_I": 0.01,
        "M_D": 0.02,
    }
    if angle > lost_from:
        measured["failure"] = "tracking lost"
    return measured


def fake_space() -> SearchSpace:
    return make_space(PARAMETERS, SlamConfiguration(slam="odometry"))


def run(folder: str, sampler: str, budget: int, evaluation: FakeEvaluation) -> None:
    """Go on with a study, in a process of its own."""
    explore(Path(folder), fake_space(), ExplorationSettings(sampler=sampler), evaluation, budget)
