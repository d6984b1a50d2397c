"""What an episode consists of so far."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import RGBDFrame
from ms_slam_env.divergence import Histograms
from ms_slam_env.env.pose_sources import Sighting, relative_motion
from ms_slam_env.errors import InputError
from ms_slam_env.slam.base import TrackResult

Float64 = NDArray[np.float64]


@dataclass
class EpisodeState:
    """Trajectories, last frame and running measures of one episode.

    One step brings one frame or several. ``truth``, ``kinematics``, ``estimates``, ``tracked``,
    ``processed``, ``times``, ``errors`` and ``frame_divergences`` (from the frame before) have an
    entry a frame; the step's ``divergence`` compares its last frame with the last one of the step
    before, and ``step_divergences`` has one for the start, zero, and for each step.
    """

    scene: str
    scene_seed: int
    noise_seed: int
    frame_index: int = 0
    time_s: float = 0.0
    energy_j: float = 0.0
    action: int = 0
    steps_lost: int = 0
    tracking_ok: bool = True
    inlier_fraction: float = 1.0
    squared_error_sum: float = 0.0
    truth: list[Float64] = field(default_factory=list)
    kinematics: list[Float64] = field(default_factory=list)
    estimates: list[Float64] = field(default_factory=list)
    tracked: list[bool] = field(default_factory=list)
    processed: list[bool] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    frame_divergences: list[Float64] = field(default_factory=list)
    divergence: Float64 = field(default_factory=lambda: np.zeros(2))
    step_divergences: list[Float64] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    reward_terms: dict[str, float] = field(default_factory=dict)
    histograms: Histograms | None = None
    step_histograms: Histograms | None = None
    frame: RGBDFrame | None = None
    predicted_divergences: Float64 | None = None

    def sighting(
        self, frame: RGBDFrame | None, T_true: Float64, T_kinematic: Float64, time_s: float
    ) -> Sighting:
        """What is known of a moment; where no frame was delivered the last one is still there."""
        first = not self.truth
        return Sighting(
            frame=frame or replace(self.last_frame, timestamp=time_s),
            T_world_camera=T_true,
            T_world_camera_kinematic=T_kinematic,
            T_previous_camera_kinematic=relative_motion(
                T_kinematic if first else self.kinematics[-1], T_kinematic
            ),
            T_world_previous_estimate=T_true if first else self.estimates[-1],
        )

    def record(self, sighting: Sighting, result: TrackResult, divergence: Float64) -> None:
        """Append what one frame brought; ``divergence`` (2,) is from the frame before."""
        frame = sighting.frame
        self.frame = frame
        self.frame_index += 1
        self.time_s = frame.timestamp
        self.tracking_ok = result.tracking_ok
        self.inlier_fraction = result.inlier_fraction
        self.truth.append(sighting.T_world_camera.copy())
        self.kinematics.append(sighting.T_world_camera_kinematic.copy())
        self.estimates.append(result.T_world_camera.copy())
        self.tracked.append(result.tracking_ok)
        self.processed.append(result.processed)
        self.times.append(frame.timestamp)
        self.frame_divergences.append(divergence)
        error = float(np.linalg.norm(result.T_world_camera[:3, 3] - sighting.T_world_camera[:3, 3]))
        self.errors.append(error)
        self.squared_error_sum += error**2
        self.predicted_divergences = None

    def end_step(self, divergence: Float64, energy_j: float) -> None:
        """Close a step after its last frame; ``divergence`` (2,) is from the step before."""
        self.divergence = divergence
        self.step_divergences.append(divergence)
        self.step_histograms = self.histograms
        self.energy_j += energy_j
        self.steps_lost = 0 if self.tracking_ok else self.steps_lost + 1

    @property
    def last_frame(self) -> RGBDFrame:
        """The last live frame."""
        assert self.frame is not None  # reset records a frame before anyone can ask
        return self.frame

    @property
    def T_world_camera_estimate(self) -> Float64:
        """(4, 4) the last estimated pose."""
        return self.estimates[-1]

    @property
    def pose_error(self) -> float:
        """Distance between the true and the estimated position now, metres."""
        return self.errors[-1] if self.errors else 0.0

    @property
    def ate(self) -> float:
        """RMSE of the position over the episode so far, metres, no alignment."""
        return float(np.sqrt(self.squared_error_sum / max(1, len(self.errors))))

    def info(self) -> dict[str, Any]:
        """What ``info`` says of the episode itself; the arrays are copies."""
        return {
            "T_world_camera": self.truth[-1].copy(),
            "T_world_camera_estimate": self.T_world_camera_estimate.copy(),
            "pose_error": self.pose_error,
            "ate": self.ate,
            "divergence": self.divergence.copy(),
            "tracking_ok": self.tracking_ok,
            "reward_terms": dict(self.reward_terms),
            "time": self.time_s,
            "energy": self.energy_j,
            "scene": self.scene,
            "scene_seed": self.scene_seed,
        }

    def copy(self) -> EpisodeState:
        """An independent copy."""
        return copy.deepcopy(self)


def check_same_settings(saved: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Refuse a state that an environment with other options saved.

    Raises:
        InputError: naming the first option that differs and both values.
    """
    for name, value in own.items():
        if name not in saved or saved[name] != value:
            raise InputError(
                f"the state was saved with {name} = {saved.get(name)!r}, "
                f"this environment has {value!r}"
            )
