"""Finding the pose again once tracking is lost: from keyframes anywhere in the map, or not."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import make_pose, relative_angle, so3_exp
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.ferns import Candidate, FernConfig, FernDatabase
from ms_slam_env.slam.surfel.seeds import tracking_seeds
from ms_slam_env.slam.surfel.tracking import Alignment
from ms_slam_env.slam.surfel.verdict import OK, make_limits

Bool = NDArray[np.bool_]

CANDIDATES = 3  # keyframes tried a frame
_LOOKED_AT = 12  # keyframes among which they are chosen
_APART_M, _APART_DEG = 0.10, 10.0  # two of them differ by at least so much
_SETTLED_M, _SETTLED_DEG = 0.03, 3.0  # largest motion of a repeated alignment
_TURN_DEG = 14.0


class AlignFrom(Protocol):
    """Aligns the current frames with the maps as seen from poses (B, 4, 4)."""

    def __call__(self, origins: Float64, seeds: Float64, limits: NDArray[np.void]) -> Alignment:
        """``seeds`` (B, K, 4, 4) start relative to ``origins``."""


def _signed_turns(degrees: float) -> list[Float64]:
    turns = [sign * np.radians(degrees) * axis for axis in np.eye(3)[[1, 0, 2]] for sign in (1, -1)]
    return [make_pose(so3_exp(turn), np.zeros(3)) for turn in turns]


_SEEDS = np.stack([np.eye(4), np.eye(4), *_signed_turns(_TURN_DEG)])
"""Starts (8, 4, 4) relative to a keyframe; as in tracking, a turn stands for a step too."""


class Relocalisation(ABC):
    """Where a lost frame is searched besides around the last good pose, for B envs."""

    @abstractmethod
    def remember(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        poses: Float64,
        time: NDArray[np.int32],
        tracked: Bool,
    ) -> None:
        """Take note of frames (B, H, W, ...) that were ``tracked`` (B,) at ``poses`` (B, 4, 4)."""

    @abstractmethod
    def search(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        lost: Bool,
        align: AlignFrom,
    ) -> tuple[Bool, Alignment] | None:
        """Search the map for the frames of the envs that are ``lost`` (B,).

        Returns:
            Which of them were found (B,), and where; None if none was.
        """

    @abstractmethod
    def similar(
        self, env: int, color: NDArray[np.uint8], depth: NDArray[np.float32], before: int
    ) -> list[Candidate]:
        """The best few keyframes from before a time that resemble a frame, best first."""

    @abstractmethod
    def move(self, env: int, time: NDArray[np.int32], poses: Float64) -> None:
        """Follow a map that was bent: frames ``time`` (N,) were taken at ``poses`` (N, 4, 4)."""

    @abstractmethod
    def clear(self, env: int) -> None:
        """Forget everything about one env."""

    @abstractmethod
    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of the same variant, batch and camera."""


class LocalSearch(Relocalisation):
    """Nothing besides the search around the last good pose."""

    def remember(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        poses: Float64,
        time: NDArray[np.int32],
        tracked: Bool,
    ) -> None:
        """Nothing to remember."""

    def search(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        lost: Bool,
        align: AlignFrom,
    ) -> tuple[Bool, Alignment] | None:
        """Nowhere else to search."""
        return None

    def similar(
        self, env: int, color: NDArray[np.uint8], depth: NDArray[np.float32], before: int
    ) -> list[Candidate]:
        """No keyframes."""
        return []

    def move(self, env: int, time: NDArray[np.int32], poses: Float64) -> None:
        """Nothing to move."""

    def clear(self, env: int) -> None:
        """Nothing to forget."""

    def get_state(self) -> dict[str, Any]:
        """Nothing to keep."""
        return {}

    def set_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


class FernRelocalisation(Relocalisation):
    """Searches from the keyframes that resemble the lost frame.

    Glocker et al., TVCG 2015. A pose is believed only if the alignment, repeated from there, stays
    there, and the next frame is found close to it.
    """

    def __init__(self, batch: int, intrinsics: Intrinsics, depth_cutoff_m: float) -> None:
        """Start without keyframes."""
        config = FernConfig(far_m=max(depth_cutoff_m, 2 * FernConfig.near_m))
        self.databases = [FernDatabase(intrinsics, config) for _ in range(batch)]
        self._tentative: Float64 = np.full((batch, 4, 4), np.nan)

    def remember(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        poses: Float64,
        time: NDArray[np.int32],
        tracked: Bool,
    ) -> None:
        """Keep the tracked frames that resemble no keyframe."""
        self._tentative[tracked] = np.nan
        for env in np.flatnonzero(tracked):
            self.databases[env].observe(color[env], depth[env], poses[env], int(time[env]))

    def search(
        self,
        color: NDArray[np.uint8],
        depth: NDArray[np.float32],
        lost: Bool,
        align: AlignFrom,
    ) -> tuple[Bool, Alignment] | None:
        """Confirm the poses that the last frames were found at, or find poses to confirm."""
        found = np.zeros(len(lost), dtype=bool)
        alignment = None
        expected = lost & np.isfinite(self._tentative[:, 0, 0])
        if expected.any():
            alignment = self._align(align, self._tentative, tracking_seeds(np.eye(4)), 0)
            found = expected & (alignment.verdict == OK)
        self._tentative[lost] = np.nan
        self._find(color, depth, lost & ~found, align)
        return (found, alignment) if alignment is not None and found.any() else None

    def _find(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32], lost: Bool, align: AlignFrom
    ) -> None:
        """Set tentative poses from keyframes, of the envs ``lost`` (B,)."""
        origins = np.full((CANDIDATES, len(lost), 4, 4), np.nan)
        for env in np.flatnonzero(lost):
            near = self.databases[env].candidates(color[env], depth[env], _LOOKED_AT)
            for rank, candidate in enumerate(_spread(near)[:CANDIDATES]):
                origins[rank, env] = candidate.T_world_camera
        for starts in origins:
            lost = lost & np.isfinite(starts[:, 0, 0])
            if not lost.any():
                return
            first = self._align(align, starts, _SEEDS, 3)
            good = lost & (first.verdict == OK)
            if not good.any():
                continue
            again = self._align(
                align,
                np.where(good[:, None, None], first.T_world_live, np.nan),
                np.tile(np.eye(4), (8, 1, 1)),
                0,
            )
            for env in np.flatnonzero(good & (again.verdict == OK)):
                if _is_close(
                    first.T_world_live[env], again.T_world_live[env], _SETTLED_M, _SETTLED_DEG
                ):
                    self._tentative[env] = again.T_world_live[env]
                    lost[env] = False

    def _align(self, align: AlignFrom, starts: Float64, seeds: Float64, reach: int) -> Alignment:
        """Align from ``starts`` (B, 4, 4), where that is finite, under strict limits."""
        batch = len(starts)
        origins = np.where(np.isfinite(starts), starts, np.eye(4))
        limits = make_limits(np.ones(batch, dtype=bool), np.full(batch, reach, dtype=np.int32))
        return align(origins, np.tile(seeds, (batch, 1, 1, 1)), limits)

    def similar(
        self, env: int, color: NDArray[np.uint8], depth: NDArray[np.float32], before: int
    ) -> list[Candidate]:
        """At most ``CANDIDATES``, apart from each other."""
        near = self.databases[env].candidates(color, depth, _LOOKED_AT, before)
        return _spread(near)[:CANDIDATES]

    def move(self, env: int, time: NDArray[np.int32], poses: Float64) -> None:
        """Put the keyframes where their frames are now."""
        database = self.databases[env]
        moved = database.poses
        index = np.searchsorted(time, database.times)
        known = (index < len(time)) & (time[np.minimum(index, len(time) - 1)] == database.times)
        moved[known] = poses[index[known]]
        database.move(moved)

    def clear(self, env: int) -> None:
        """Forget the keyframes of one env."""
        self.databases[env].clear()
        self._tentative[env] = np.nan

    def get_state(self) -> dict[str, Any]:
        """Keyframes and poses to confirm."""
        return {
            "databases": [database.get_state() for database in self.databases],
            "tentative": self._tentative.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        for database, kept in zip(self.databases, state["databases"], strict=True):
            database.set_state(kept)
        self._tentative = state["tentative"].copy()


def _spread(candidates: list[Candidate]) -> list[Candidate]:
    """Those that lie apart from all better ones."""
    chosen: list[Candidate] = []
    for one in candidates:
        if not any(
            _is_close(one.T_world_camera, other.T_world_camera, _APART_M, _APART_DEG)
            for other in chosen
        ):
            chosen.append(one)
    return chosen


def _is_close(a: Float64, b: Float64, distance_m: float, angle_deg: float) -> bool:
    near = np.linalg.norm(a[:3, 3] - b[:3, 3]) <= distance_m
    return bool(near and relative_angle(a[:3, :3], b[:3, :3]) <= np.radians(angle_deg))


RELOCALISATIONS = ("ferns", "local")


def make_relocalisation(
    name: str, batch: int, intrinsics: Intrinsics, depth_cutoff_m: float
) -> Relocalisation:
    """Make the variant ``name``, one of ``RELOCALISATIONS``."""
    if name == "local":
        return LocalSearch()
    return FernRelocalisation(batch, intrinsics, depth_cutoff_m)
