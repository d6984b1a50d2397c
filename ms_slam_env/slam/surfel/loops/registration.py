"""Where the live frames lie in the inactive part of the map: near by, or where a keyframe was."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.geometry import relative_angle
from ms_slam_env.slam.surfel.config import SurfelConfig
from ms_slam_env.slam.surfel.loops.base import Bool, Float64
from ms_slam_env.slam.surfel.mirror import Mirror
from ms_slam_env.slam.surfel.seeds import NUM_SEEDS, relocalisation_seeds, tracking_seeds
from ms_slam_env.slam.surfel.splat_renderer import SplatRenderer
from ms_slam_env.slam.surfel.surfel_map import SurfelMap
from ms_slam_env.slam.surfel.tracking import Alignment, Tracker, model_stride
from ms_slam_env.slam.surfel.types import LiveFrame
from ms_slam_env.slam.surfel.verdict import OK, STAT_SIGMA, make_limits

SETTLED_M, SETTLED_DEG = 0.02, 2.0  # largest motion of a repeated registration


@dataclass(frozen=True)
class Placement:
    """Where frames lie in the inactive part.

    Attributes:
        found: (B,) whether the registration succeeded.
        T_world_live: (B, 4, 4) pose.
        sigma: (B,) standard deviation of its worst direction, metres and radians.
    """

    found: Bool
    T_world_live: Float64
    sigma: Float64


def _placement(found: Bool, alignment: Alignment) -> Placement:
    return Placement(found, alignment.T_world_live, alignment.stats[:, STAT_SIGMA])


def _nowhere(batch: int) -> Placement:
    return Placement(
        np.zeros(batch, dtype=bool), np.tile(np.eye(4), (batch, 1, 1)), np.zeros(batch)
    )


class InactiveRegistration:
    """Registers the frames of B envs with the inactive part of their maps."""

    def __init__(
        self, surfel_map: SurfelMap, inactive: SplatRenderer, config: SurfelConfig, device: str
    ) -> None:
        """Own a tracker; ``inactive`` renders the inactive surfels."""
        self.config = config.loops
        self.batch = surfel_map.batch
        self._inactive = inactive
        intrinsics = surfel_map.intrinsics
        stride = model_stride(intrinsics, config)
        self._tracker = Tracker(self.batch, NUM_SEEDS, intrinsics, config, device, stride)
        self._poses = Mirror(self.batch, wp.mat44, device)

    def set_frame(self, live: LiveFrame) -> None:
        """Take the frames that are registered next."""
        self._tracker.set_frame(live)

    def covered(self, poses: Float64, due: Bool) -> Bool:
        """Which of the envs that are ``due`` (B,) see enough of the inactive part from ``poses``.

        The view of it is at hand then.
        """
        self._poses.write(poses)
        self._inactive.cull(self._poses.array)
        pixels = self._inactive.intrinsics.width * self._inactive.intrinsics.height
        counts = self._inactive.visible.count.numpy()
        due = due & (counts > 0.1 * self.config.coverage * pixels)
        if not due.any():
            return due
        view = self._inactive.splat()
        shares = (view.vertices.numpy()[..., 2] > 0).mean(axis=(1, 2))
        return due & (shares >= self.config.coverage)

    def near(self, poses: Float64) -> Placement:
        """Register with the view that ``covered`` rendered from ``poses``."""
        found = self._align(poses, tracking_seeds(np.eye(4)), self._limits(self.config.largest_m))
        return _placement(found.verdict == OK, found)

    def from_keyframes(self, starts: Float64) -> Placement:
        """Register from poses (B, 4, 4) that are rough and may be wrong, NaN for an env without.

        What is found must be found again from there.
        """
        given = np.isfinite(starts[:, 0, 0])
        origins = np.where(given[:, None, None], starts, np.eye(4))
        limits = self._limits(0.6)
        given &= self.covered(origins, given)
        if not given.any():
            return _nowhere(self.batch)
        first = self._align(origins, relocalisation_seeds(0), limits)
        good = given & (first.verdict == OK)
        origins = np.where(good[:, None, None], first.T_world_live, np.eye(4))
        good &= self.covered(origins, good)
        if not good.any():
            return _nowhere(self.batch)
        again = self._align(origins, tracking_seeds(np.eye(4)), self._limits(0.1))
        good &= again.verdict == OK
        for env in np.flatnonzero(good):
            good[env] = _is_settled(origins[env], again.T_world_live[env])
        return _placement(good, again)

    def _align(self, origins: Float64, seeds: Float64, limits: NDArray[Any]) -> Alignment:
        stack = np.tile(seeds, (self.batch, 1, 1, 1))
        return self._tracker.align(self._inactive.view, origins, stack, limits)

    def _limits(self, motion_m: float) -> NDArray[Any]:
        limits = make_limits(np.ones(self.batch, bool), np.zeros(self.batch, np.int32))
        limits["sigma"] = self.config.sigma
        limits["inliers"] = self.config.inliers
        limits["motion_m"] = motion_m
        limits["motion_cos"] = np.cos(np.radians(self.config.largest_deg))
        return limits


def _is_settled(a: Float64, b: Float64) -> bool:
    near = np.linalg.norm(a[:3, 3] - b[:3, 3]) <= SETTLED_M
    return bool(near and relative_angle(a[:3, :3], b[:3, :3]) <= np.radians(SETTLED_DEG))
