"""What tracking found for one frame of each of B envs: arrays, and results made of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float64, Int32
from ms_slam_env.slam.shared.alignment_check import MAP_REASONS, TrackingStatus, failed_demand
from ms_slam_env.slam.slam_backend import Loop, TrackResult
from ms_slam_env.slam.surfel.acceptance import Alignment

NO_START = "the first frame has too few depth readings"


@dataclass(frozen=True)
class TrackedBatch:
    """Results of B envs; see ``TrackResult``, whose fields have the same names here.

    Attributes:
        T_world_camera: (B, 4, 4) estimated poses; the last good ones while tracking is lost.
        tracking_ok: (B,) whether the pose is known.
        uncertain: (B,) whether it is doubtful, and nothing was fused.
        relocalised: (B,) whether this frame ended a period of lost tracking.
        is_first: (B,) whether the env had no map before: the frame is its first, or shows too
            little to start one.
        status: (B,) int32 ``TrackingStatus``.
        inlier_fraction: (B,) share of the valid pixels that the alignment explains.
        residual_m: (B,) RMS point-to-plane residual of the inliers, metres.
        overlap: (B,) share of the readings that land on the view.
        degenerate_directions: (B,) int32, of the pose's six, that the view does not constrain.
        covariance: (B, 6, 6) of the poses; NaN for a first frame and one that was not tracked.
        drift: (B, 6, 6) of the maps about the cameras in the world; meaningless where
            ``covariance`` is NaN.
        alignment: what was found for the frames and demanded of it.
        loop_closed: (B,) whether the map was deformed, so that the pose jumped.
        loops: the loops that were found, by env.
    """

    T_world_camera: Float64
    tracking_ok: Bool
    uncertain: Bool
    relocalised: Bool
    is_first: Bool
    status: Int32
    inlier_fraction: Float64
    residual_m: Float64
    overlap: Float64
    degenerate_directions: Int32
    covariance: Float64
    drift: Float64
    alignment: Alignment
    loop_closed: Bool
    loops: dict[int, Loop] = field(default_factory=dict)

    @property
    def fused(self) -> Bool:
        """Which frames (B,) became part of the map."""
        return self.tracking_ok & ~self.uncertain

    def results(self, mask: Callable[[int], NDArray[np.bool_] | None]) -> list[TrackResult]:
        """One result an env; ``mask`` gives what moves in an env's frame, (h, w)."""
        return [self._result(env, mask) for env in range(len(self.status))]

    def _result(self, env: int, mask: Callable[[int], NDArray[np.bool_] | None]) -> TrackResult:
        is_ok, is_first = bool(self.tracking_ok[env]), bool(self.is_first[env])
        found_nothing = is_first and not is_ok
        return TrackResult(
            T_world_camera=self.T_world_camera[env].copy(),
            tracking_ok=is_ok,
            relocalised=bool(self.relocalised[env]),
            inlier_fraction=float(self.inlier_fraction[env]),
            residual_m=float(self.residual_m[env]),
            reason=NO_START if found_nothing else MAP_REASONS[int(self.status[env])],
            degenerate_directions=int(self.degenerate_directions[env]),
            covariance=self.covariance[env].copy() if is_ok and not is_first else None,
            drift=self.drift[env].copy() if is_ok and not is_first else None,
            uncertain=bool(self.uncertain[env]),
            overlap=float(self.overlap[env]),
            loop_closed=bool(self.loop_closed[env]),
            loop=self.loops.get(env),
            moving=None if found_nothing else mask(env),
            refusal="" if is_ok or is_first else self._refusal(env),
        )

    def _refusal(self, env: int) -> str:
        found, status = self.alignment, int(self.status[env])
        return failed_demand(found.statistics[env], found.thresholds[env], status)


def tracked_batch(
    alignment: Alignment,
    started: Bool,
    begins: Bool,
    lost: Bool,
    poses: Float64,
    doubt: Float64,
    drift: Float64,
) -> TrackedBatch:
    """Results of the frames of envs that had ``started`` (B,), or begin with them (B,).

    ``poses`` (B, 4, 4) are those after the frames, ``lost`` (B,) says which tracking had been lost
    before; ``doubt`` (B, 6, 6) is added to the covariance of uncertain poses.
    """
    uncertain = started & alignment.uncertain
    tracked = uncertain | (started & alignment.tracked)
    found = alignment.statistics
    covariance = np.where(tracked[:, None, None], alignment.covariance, np.nan)
    covariance[uncertain] += doubt[uncertain]
    at_start = np.where(begins, TrackingStatus.OK, TrackingStatus.FEW_POINTS)
    as_first = np.where(begins, 1.0, 0.0)
    return TrackedBatch(
        T_world_camera=poses.copy(),
        tracking_ok=tracked | begins,
        uncertain=uncertain,
        relocalised=tracked & lost,
        is_first=~started,
        status=np.where(started, alignment.status, at_start).astype(np.int32),
        inlier_fraction=np.where(started, found["inlier_ratio"], as_first),
        residual_m=np.where(started, found["residual_m"], 0.0),
        overlap=np.where(started, found["overlap"], as_first),
        degenerate_directions=np.where(started, found["degenerate_directions"], 0).astype(np.int32),
        covariance=covariance,
        drift=drift,
        alignment=alignment,
        loop_closed=np.zeros(len(started), dtype=bool),
    )
