"""Keyframes that are found again by their fern codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.slam.ferns.config import FernConfig
from ms_slam_env.slam.ferns.encoding import FernCode, FernEncoder, UInt8, dissimilarities

Float64 = NDArray[np.float64]

_FIRST_ROWS = 64


@dataclass(frozen=True)
class Candidate:
    """A keyframe that resembles a frame.

    Attributes:
        T_world_camera: (4, 4) its pose.
        dissimilarity: share of ferns that differ, [0, 1].
        index: of the keyframe in the database.
        time: when it was observed.
    """

    T_world_camera: Float64
    dissimilarity: float
    index: int
    time: int


class FernDatabase:
    """Keeps the frames that differ from all kept before, and finds those that resemble another.

    Glocker et al., TVCG 2015, see ``encoding``. The same seed draws the same ferns.
    """

    def __init__(
        self, intrinsics: Intrinsics, config: FernConfig | None = None, seed: int = 0
    ) -> None:
        """Start empty."""
        self.config = config or FernConfig()
        self._seed = seed
        self._encoder = FernEncoder(intrinsics, self.config, seed)
        self.clear()

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return self._count

    @property
    def poses(self) -> Float64:
        """Poses (K, 4, 4) of the keyframes, a copy."""
        return self._poses[: self._count].copy()

    @property
    def times(self) -> NDArray[np.int64]:
        """When each keyframe was observed (K,), a copy."""
        return self._times[: self._count].copy()

    def clear(self) -> None:
        """Forget all keyframes."""
        ferns = self.config.num_ferns
        self._count = 0
        self._bits: UInt8 = np.zeros((_FIRST_ROWS, ferns), dtype=np.uint8)
        self._known: UInt8 = np.zeros((_FIRST_ROWS, ferns), dtype=np.uint8)
        self._poses: Float64 = np.zeros((_FIRST_ROWS, 4, 4))
        self._times = np.zeros(_FIRST_ROWS, dtype=np.int64)

    def expect_size(self, intrinsics: Intrinsics) -> None:
        """Take frames of another size of the same camera from now on; the keyframes stay.

        Raises:
            InputError: frames of another shape, or smaller than those that ferns test.
        """
        encoder = FernEncoder(intrinsics, self.config, self._seed)
        if encoder.tested_size != self._encoder.tested_size:
            raise InputError(
                f"frames of {intrinsics.width}x{intrinsics.height} have other ferns: they test "
                f"{encoder.tested_size} in place of {self._encoder.tested_size} pixels"
            )
        self._encoder = encoder

    def encode(self, color: UInt8, depth: NDArray[np.float32]) -> FernCode:
        """Code of a frame, for the methods that take one: colour (H, W, 3), depth (H, W) metres."""
        return self._encoder.encode(color, depth)

    def observe(
        self, color: UInt8, depth: NDArray[np.float32], T_world_camera: ArrayLike, time: int = 0
    ) -> bool:
        """Keep a frame taken at ``T_world_camera`` (4, 4) if none that is kept resembles it.

        Raises:
            InputError: no pose.
        """
        return self.observe_code(self.encode(color, depth), T_world_camera, time)

    def observe_code(self, code: FernCode, T_world_camera: ArrayLike, time: int = 0) -> bool:
        """The same for a frame that is encoded already; return whether it was kept.

        Raises:
            InputError: no pose.
        """
        pose = check_pose(T_world_camera, "T_world_camera")
        if self._count and self.dissimilarities(code).min() <= self.config.keyframe_dissimilarity:
            return False
        if self._count == len(self._bits):
            self._grow()
        row = self._count
        self._bits[row], self._known[row] = code.bits, code.known
        self._poses[row], self._times[row] = pose, time
        self._count += 1
        return True

    def candidates(
        self,
        color: UInt8,
        depth: NDArray[np.float32],
        count: int,
        before: int | None = None,
    ) -> list[Candidate]:
        """The at most ``count`` keyframes that resemble a frame most, the best first.

        Args:
            color: (H, W, 3) uint8.
            depth: (H, W) metres; 0 = no reading.
            count: at most so many.
            before: only keyframes observed before this time; all if None.
        """
        return self.candidates_of(self.encode(color, depth), count, before)

    def candidates_of(
        self, code: FernCode, count: int, before: int | None = None
    ) -> list[Candidate]:
        """The same for a frame that is encoded already."""
        found = self.dissimilarities(code)
        if before is not None:
            found = np.where(self._times[: self._count] < before, found, np.inf)
        order = np.argsort(found, kind="stable")[:count]
        return [
            Candidate(
                self._poses[index].copy(), float(found[index]), int(index), int(self._times[index])
            )
            for index in order
            if np.isfinite(found[index])
        ]

    def dissimilarities(self, code: FernCode) -> Float64:
        """Share of ferns (K,) at which each keyframe differs from a frame."""
        return dissimilarities(code, self._bits[: self._count], self._known[: self._count])

    def move(self, poses: ArrayLike) -> None:
        """Put all keyframes at new poses (K, 4, 4), where a loop closure has bent the map.

        Raises:
            InputError: another number of poses, or what is none.
        """
        stack = np.asarray(poses, dtype=np.float64)
        if stack.shape != (self._count, 4, 4):
            raise InputError(f"poses must have shape {(self._count, 4, 4)}, got {stack.shape}")
        for pose in stack:
            check_pose(pose, "poses")
        self._poses[: self._count] = stack

    def transform(self, T_new_old: ArrayLike) -> None:
        """Move all keyframes by one rigid motion (4, 4) of the world.

        Raises:
            InputError: no rigid motion.
        """
        self._poses[: self._count] = check_pose(T_new_old, "T_new_old") @ self._poses[: self._count]

    def get_state(self) -> dict[str, Any]:
        """Everything needed to go on bit-exactly, as NumPy arrays."""
        rows = slice(self._count)
        return {
            "bits": self._bits[rows].copy(),
            "known": self._known[rows].copy(),
            "poses": self._poses[rows].copy(),
            "times": self._times[rows].copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a state of a database of the same camera, configuration and seed."""
        self._count = len(state["bits"])
        self._bits = state["bits"].copy()
        self._known = state["known"].copy()
        self._poses = state["poses"].copy()
        self._times = state["times"].copy()

    def _grow(self) -> None:
        """Double the capacity."""
        self._bits = _with_more_rows(self._bits)
        self._known = _with_more_rows(self._known)
        self._poses = _with_more_rows(self._poses)
        self._times = _with_more_rows(self._times)


def _with_more_rows(array: NDArray[Any]) -> NDArray[Any]:
    """``array`` (N, ...) followed by at least as many rows of zeros."""
    more = max(_FIRST_ROWS, len(array))
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)])
