"""The camera motion of a planner's episode, to be rendered again as a sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.planners import check_planner, make_planner
from ms_slam_env.experiments.harness.episodes import EpisodeSpec, make_env, play

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class PlannedMotion:
    """Where a planner moved the camera, and how SLAM fared in the episode.

    Attributes:
        times_s: (N,) simulated seconds of each frame from the episode's start.
        poses: (N, 4, 4) true T_world_camera of every frame, those within a step among them.
        steps: that the episode lasted.
        lost_frames: frames that SLAM did not track.
    """

    times_s: Float64
    poses: Float64
    steps: int
    lost_frames: int

    def about(self) -> dict[str, Any]:
        """What to note of the episode beside the sequence."""
        return {"episode_steps": self.steps, "episode_lost_frames": self.lost_frames}


def planned_motion(spec: EpisodeSpec) -> PlannedMotion:
    """Run an episode and return its true motion; the same spec gives the same motion.

    Raises:
        InputError: an unknown planner, scene or option, or no start pose.
    """
    check_planner(spec.planner)
    env = make_env(spec)
    try:
        world = cast(ActiveSlamEnv, env.unwrapped)
        progress = play(env, make_planner(spec.planner, world, spec.seed), spec.seed)
        return PlannedMotion(
            times_s=world.episode.timestamps,
            poses=world.episode.trajectory_truth,
            steps=progress["steps"],
            lost_frames=int((~world.episode.tracked).sum()),
        )
    finally:
        env.close()
