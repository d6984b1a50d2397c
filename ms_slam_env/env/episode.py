"""Record of an episode so far: frames, trajectories and measures."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import RGBDFrame
from ms_slam_env.divergence import Histograms
from ms_slam_env.env.pose_sources import FrameObservation
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import invert
from ms_slam_env.planning import OccupancyGrid
from ms_slam_env.slam.slam_backend import TrackResult


@dataclass(frozen=True)
class FrameRecord:
    """Record of one frame.

    Attributes:
        T_world_camera: (4, 4) true pose.
        T_world_camera_kinematic: (4, 4) pose from forward kinematics, equal to the truth at the
            start.
        T_world_camera_estimate: (4, 4) pose estimated when the frame was current.
        tracking_ok: whether tracking held.
        processed: whether SLAM processed the frame.
        submap: index of the frame's submap, 0 for the first and those joined to it by then.
        time_s: simulated seconds since the start.
        divergence: (2,) from the frame before, nats; -1 where it was not measured.
        pose_error: distance between the true and the estimated position, metres.
    """

    T_world_camera: Float64
    T_world_camera_kinematic: Float64
    T_world_camera_estimate: Float64
    tracking_ok: bool
    processed: bool
    submap: int
    time_s: float
    divergence: Float64
    pose_error: float


_GROWING = ("frames", "divergences_of_steps", "reward_terms")


@dataclass
class Episode:
    """Trajectories, last frame and running measures of an episode of N frames in S steps.

    A step has one or more frames; its divergence compares its last frame with the last one of the
    step before.

    Attributes:
        scene, scene_seed: where the episode takes place.
        noise_seed: seed of the sensor noise.
        energy_j: mechanical work of the motion so far.
        action: index of the last motion, 0 before the first; a continuous one as a twist (6,), in
            units of a step.
        steps_lost: consecutive steps for which tracking has been lost.
        steps_away: consecutive steps in which the camera has not been tracked in the first submap
            or one joined to it.
        tracking_ok, inlier_fraction: reported by SLAM for the last frame.
        frames: (N) records of the frames.
        divergences_of_steps: (S + 1) zero for the start, then one for each step, (2,) nats.
        reward_terms: of the last step, name to weighted value.
        histograms, step_histograms: of the last frame, and of the last one of the step before.
        frame: the last live frame.
        pose_covariance: (6, 6) of the last estimated pose, as in ``TrackResult``; None where none
            was estimated: at the start, while lost, or with a pose source that gives none.
        predicted_divergences: (n, 2) of the candidates, once they have been requested.
        occupancy: carved from the last frame of each step, where the observation needs it.
    """

    scene: str
    scene_seed: int
    noise_seed: int
    energy_j: float = 0.0
    action: int | Float64 = 0
    steps_lost: int = 0
    steps_away: int = 0
    tracking_ok: bool = True
    inlier_fraction: float = 1.0
    squared_error_sum: float = 0.0
    frames: list[FrameRecord] = field(default_factory=list)
    divergences_of_steps: list[Float64] = field(default_factory=list)
    reward_terms: dict[str, float] = field(default_factory=dict)
    histograms: Histograms | None = None
    step_histograms: Histograms | None = None
    frame: RGBDFrame | None = None
    pose_covariance: Float64 | None = None
    predicted_divergences: Float64 | None = None
    occupancy: OccupancyGrid | None = None

    # -- Writing -----------------------------------------------------------------------------

    def observe(
        self, frame: RGBDFrame | None, T_true: Float64, T_kinematic: Float64, time_s: float
    ) -> FrameObservation:
        """Observe one moment; if no frame was delivered, the last one stays."""
        before = self._last_known()
        T_last_kinematic = before.T_world_camera_kinematic if before else T_kinematic
        return FrameObservation(
            frame=frame or replace(self.last_frame, timestamp=time_s),
            T_world_camera=T_true,
            T_world_camera_kinematic=T_kinematic,
            T_previous_camera_kinematic=invert(T_last_kinematic) @ T_kinematic,
            T_world_previous_estimate=before.T_world_camera_estimate if before else T_true,
        )

    def _last_known(self) -> FrameRecord | None:
        """The last tracked frame, from which motion accumulates; if there is none, the last."""
        tracked = (frame for frame in reversed(self.frames) if frame.tracking_ok)
        return next(tracked, self.frames[-1] if self.frames else None)

    def record(self, seen: FrameObservation, result: TrackResult, divergence: Float64) -> None:
        """Append the record of one frame; ``divergence`` (2,) is from the frame before."""
        off = result.T_world_camera[:3, 3] - seen.T_world_camera[:3, 3]
        made = FrameRecord(
            T_world_camera=seen.T_world_camera.copy(),
            T_world_camera_kinematic=seen.T_world_camera_kinematic.copy(),
            T_world_camera_estimate=result.T_world_camera.copy(),
            tracking_ok=result.tracking_ok,
            processed=result.processed,
            submap=result.submap,
            time_s=seen.frame.timestamp,
            divergence=divergence,
            pose_error=float(np.linalg.norm(off)),
        )
        for array in vars(made).values():
            if isinstance(array, np.ndarray):
                array.flags.writeable = False  # copies of the episode share it
        self.frames.append(made)
        self.frame = seen.frame
        self.tracking_ok = result.tracking_ok
        self.inlier_fraction = result.inlier_fraction
        self.pose_covariance = result.covariance
        self.squared_error_sum += made.pose_error**2
        self.predicted_divergences = None

    def end_step(self, divergence: Float64, energy_j: float) -> None:
        """Close a step after its last frame; ``divergence`` (2,) is from the step before."""
        self.divergences_of_steps.append(divergence)
        self.step_histograms = self.histograms
        self.energy_j += energy_j
        self.steps_lost = 0 if self.tracking_ok else self.steps_lost + 1
        is_anchored = self.tracking_ok and self.frames[-1].submap == 0
        self.steps_away = 0 if is_anchored else self.steps_away + 1

    def copy(self) -> Episode:
        """An independent copy; recorded frames never change and are shared."""
        own = {name: copy.copy(getattr(self, name)) for name in _GROWING}
        occupancy = None if self.occupancy is None else self.occupancy.copy()
        return replace(self, occupancy=occupancy, **own)

    # -- The present -------------------------------------------------------------------------

    @property
    def last_frame(self) -> RGBDFrame:
        """The last live frame."""
        assert self.frame is not None  # reset has recorded one
        return self.frame

    @property
    def T_world_camera_estimate(self) -> Float64:
        """(4, 4) the last estimated pose."""
        return self.frames[-1].T_world_camera_estimate

    @property
    def T_start_camera(self) -> Float64:
        """(4, 4) the last estimated pose, relative to the start."""
        return invert(self.frames[0].T_world_camera_estimate) @ self.T_world_camera_estimate

    @property
    def pose_error(self) -> float:
        """Distance between the true and the estimated position now, metres."""
        return self.frames[-1].pose_error

    @property
    def ate(self) -> float:
        """RMSE of the position over the episode so far, metres, no alignment."""
        return float(np.sqrt(self.squared_error_sum / len(self.frames)))

    @property
    def divergence(self) -> Float64:
        """(2,) intensity and depth divergence of the last step, nats; zero at the start."""
        return self.divergences_of_steps[-1]

    def info(self) -> dict[str, Any]:
        """The episode's entries of ``info``; the arrays are copies."""
        return {
            "T_world_camera": self.frames[-1].T_world_camera.copy(),
            "T_world_camera_estimate": self.T_world_camera_estimate.copy(),
            "pose_covariance": self._covariance_or_infinite(),
            "pose_error": self.pose_error,
            "ate": self.ate,
            "divergence": self.divergence.copy(),
            "tracking_ok": self.tracking_ok,
            "submap": self.frames[-1].submap,
            "reward_terms": dict(self.reward_terms),
            "time": self.frames[-1].time_s,
            "energy": self.energy_j,
            "scene": self.scene,
            "scene_seed": self.scene_seed,
        }

    def _covariance_or_infinite(self) -> Float64:
        known = self.pose_covariance
        return np.diag(np.full(6, np.inf)) if known is None else np.array(known, dtype=np.float64)

    # -- The past ----------------------------------------------------------------------------

    @property
    def trajectory_truth(self) -> Float64:
        """(N, 4, 4) true poses."""
        return np.stack([frame.T_world_camera for frame in self.frames])

    @property
    def trajectory_estimate(self) -> Float64:
        """(N, 4, 4) poses estimated when they were current."""
        return np.stack([frame.T_world_camera_estimate for frame in self.frames])

    @property
    def trajectory_kinematics(self) -> Float64:
        """(N, 4, 4) poses from forward kinematics, equal to the truth at the first frame."""
        return np.stack([frame.T_world_camera_kinematic for frame in self.frames])

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """(N,) whether tracking held at each frame; those also processed are part of the map."""
        return np.array([frame.tracking_ok for frame in self.frames])

    @property
    def processed(self) -> NDArray[np.bool_]:
        """(N,) whether SLAM processed each frame; frame selection drops the others."""
        return np.array([frame.processed for frame in self.frames])

    @property
    def timestamps(self) -> Float64:
        """(N,) simulated seconds from the start of the episode to each frame."""
        return np.array([frame.time_s for frame in self.frames])

    @property
    def divergences(self) -> Float64:
        """(N, 2) divergence of each frame from the one before; zero for the first.

        Raises:
            InputError: the divergences were not measured.
        """
        measured = np.stack([frame.divergence for frame in self.frames])
        if (measured < 0).any():
            raise InputError("the divergence of frames needs frame_divergences=True")
        return measured

    @property
    def step_divergences(self) -> Float64:
        """(S + 1, 2) ``info["divergence"]`` at the start and after each step."""
        return np.stack(self.divergences_of_steps)

    @property
    def pose_errors(self) -> Float64:
        """(N,) distance between true and estimated position at each frame, metres."""
        return np.array([frame.pose_error for frame in self.frames])
