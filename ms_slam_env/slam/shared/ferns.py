"""Keyframe retrieval by randomised ferns, for relocalisation and global loop closure.

Glocker, Shotton, Criminisi, Izadi, "Real-Time RGB-D Camera Relocalization via Randomized Ferns for
Keyframe Encoding", TVCG 2015: frames become codes of binary tests at random places; each fern
compares red, green, blue and depth at one place of a small, smoothed image with a threshold each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ms_slam_env._runtime.arrays import Bool, Float64, Int32, UInt8
from ms_slam_env.camera import Intrinsics
from ms_slam_env.config import Checked, bounded
from ms_slam_env.errors import InputError
from ms_slam_env.geometry import check_pose
from ms_slam_env.slam.shared.device_ferns import FernTests
from ms_slam_env.slam.shared.images import Images
from ms_slam_env.slam.shared.state import Stateful
from ms_slam_env.slam.shared.state_check import ArrayOf

_THRESHOLDS = (32.0, 224.0)  # on colours, at mean brightness ``MEAN_LEVEL``
_AVERAGED = 8  # least rows and columns of the image that a reduced pixel averages
_FIRST_ROWS = 64
_COMPARED = 64  # databases whose keyframes are compared at once


@dataclass(frozen=True)
class FernConfig(Checked):
    """How frames are encoded and which are kept as keyframes.

    Attributes:
        num_ferns: number of tested image positions; each contributes four bits to the code.
        columns: width of the reduced colour image that is tested, pixels.
        blur_px: standard deviation of the Gaussian that smooths the reduced image.
        near_m: lower bound of the random depth thresholds.
        far_m: upper bound of the random depth thresholds.
        keyframe_dissimilarity: a frame is kept if it differs by more than this from every kept one.
    """

    num_ferns: int = bounded(500, 1, 100_000)
    columns: int = bounded(40, 1, 10_000)
    blur_px: float = bounded(1.0, 0.1, 20.0)
    near_m: float = bounded(0.4, 0.0, 100.0)
    far_m: float = bounded(3.0, 0.0, 100.0)
    keyframe_dissimilarity: float = bounded(0.2, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.near_m >= self.far_m:
            raise InputError(
                f"FernConfig.near_m = {self.near_m} must be below far_m = {self.far_m}"
            )


COLOUR_BITS = 7  # red 1, green 2, blue 4
DEPTH_BIT = 8
MEAN_LEVEL = 128.0  # mean brightness that frames are normalised to before the tests


@dataclass(frozen=True)
class FernCode:
    """The code of one frame."""

    bits: UInt8  # (F,) outcome of the four tests of each fern; (N, F) of several frames
    # (F,) which of the four bits are known; the depth bit is not where there is no reading.
    known: UInt8


class FernEncoder:
    """Encodes frames of one camera; test positions and thresholds are drawn from a seed.

    Attributes:
        tests: what ``DeviceFernEncoder`` needs to do the same.
    """

    def __init__(self, intrinsics: Intrinsics, config: FernConfig, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        height, width = intrinsics.shape
        columns = min(config.columns, width)
        rows = max(1, round(height * columns / width))
        self._size = (columns, rows)
        self._step = max(1, min(height // rows, width // columns) // _AVERAGED)
        self._blur_px = config.blur_px
        column = rng.integers(0, columns, config.num_ferns)
        row = rng.integers(0, rows, config.num_ferns)
        self.color_thresholds: Float64 = rng.uniform(*_THRESHOLDS, (config.num_ferns, 3))
        self.depth_thresholds: Float64 = rng.uniform(config.near_m, config.far_m, config.num_ferns)
        self._color_place = row * columns + column
        # Depth is not averaged: a mean across an edge lies on no surface.
        v = ((row + 0.5) * height / rows).astype(np.int64)
        u = ((column + 0.5) * width / columns).astype(np.int64)
        self._depth_place = v * width + u
        self.tests = FernTests(
            image=intrinsics.shape,
            reduced=(rows, columns),
            step=self._step,
            blur_px=config.blur_px,
            mean_level=MEAN_LEVEL,
            color_place=self._color_place,
            depth_place=self._depth_place,
            color_thresholds=self.color_thresholds,
            depth_thresholds=self.depth_thresholds,
        )

    @property
    def tested_size(self) -> tuple[int, int]:
        """Width and height of the reduced colour image."""
        return self._size

    def encode(self, color: UInt8, depth: NDArray[np.float32]) -> FernCode:
        """Encode a frame: colour (H, W, 3) uint8, depth (H, W) metres, 0 = no reading.

        Colours are divided by the frame's mean brightness, so a change of exposure changes no bit
        except where the image saturates.
        """
        return self._code(self._reduced(color), depth)

    def encode_all(self, images: Images, envs: Int32) -> FernCode:
        """The codes (N, F) of the frames of ``envs`` (N,)."""
        frames = [images.of(env) for env in envs.tolist()]
        small = np.stack([self._reduced(color) for color, _ in frames])
        return self._code(small, np.stack([depth for _, depth in frames]))

    def _reduced(self, color: UInt8) -> UInt8:
        """The smoothed image (h, w, 3) that is tested."""
        thinned = np.ascontiguousarray(color[:: self._step, :: self._step])
        small = cv2.resize(thinned, self._size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(small, (0, 0), self._blur_px))

    def _code(self, small: UInt8, depth: NDArray[np.float32]) -> FernCode:
        """Code (..., F) of tested images (..., h, w, 3) and depth (..., H, W)."""
        several = small.shape[:-3]
        tested = small.reshape(*several, -1, 3)[..., self._color_place, :]
        mean = small.mean(axis=(-3, -2, -1), keepdims=True)[..., 0]
        above = tested > self.color_thresholds * (np.maximum(mean, 1.0) / MEAN_LEVEL)
        reading = depth.reshape(*several, -1)[..., self._depth_place]
        bits = above @ np.array([1, 2, 4], dtype=np.uint8)
        bits |= (reading > self.depth_thresholds).astype(np.uint8) << 3
        known = np.where(reading > 0, COLOUR_BITS | DEPTH_BIT, COLOUR_BITS).astype(np.uint8)
        return FernCode(bits, known)


@lru_cache(maxsize=8)
def fern_encoder(intrinsics: Intrinsics, config: FernConfig, seed: int) -> FernEncoder:
    """An encoder that databases share: it holds nothing but what it was drawn from."""
    return FernEncoder(intrinsics, config, seed)


def dissimilarities(code: FernCode, bits: UInt8, known: UInt8) -> Float64:
    """Share of ferns (K,) at which ``code`` differs from each of K codes (K, F).

    The paper's block-wise Hamming distance: a fern differs if any of its bits does. Bits unknown in
    either frame are ignored.
    """
    different = (bits ^ code.bits) & (known & code.known)
    return np.count_nonzero(different, axis=1) / different.shape[1]


@dataclass(frozen=True)
class Candidate:
    """A keyframe that resembles a frame."""

    T_world_camera: Float64  # (4, 4) its pose
    dissimilarity: float  # share of ferns that differ, [0, 1]
    index: int  # of the keyframe in the database
    time: int  # when it was observed


_ROWS = ("_bits", "_known", "_poses", "_times")  # arrays with one row per keyframe


class FernDatabase(Stateful):
    """Keeps frames that differ from all kept before, and retrieves those similar to a query.

    The same seed draws the same ferns.
    """

    def __init__(
        self, intrinsics: Intrinsics, config: FernConfig | None = None, seed: int = 0
    ) -> None:
        self.config = config or FernConfig()
        self._seed = seed
        self._encoder = fern_encoder(intrinsics, self.config, seed)
        self.clear()

    def __len__(self) -> int:
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
        """Accept frames of another size of the same camera from now on; the keyframes stay.

        Raises:
            InputError: another aspect ratio, or smaller than the reduced image.
        """
        encoder = fern_encoder(intrinsics, self.config, self._seed)
        if encoder.tested_size != self._encoder.tested_size:
            raise InputError(
                f"frames of {intrinsics.width}x{intrinsics.height} have other ferns: they test "
                f"{encoder.tested_size} in place of {self._encoder.tested_size} pixels"
            )
        self._encoder = encoder

    @property
    def encoder(self) -> FernEncoder:
        """Encodes frames for methods that take a code."""
        return self._encoder

    def encode(self, color: UInt8, depth: NDArray[np.float32]) -> FernCode:
        """Encode a frame for methods that take a code: colour (H, W, 3), depth (H, W) metres."""
        return self._encoder.encode(color, depth)

    def observe(
        self, color: UInt8, depth: NDArray[np.float32], T_world_camera: ArrayLike, time: int = 0
    ) -> bool:
        """Keep a frame at ``T_world_camera`` (4, 4) if no kept one is similar; return whether."""
        return self.observe_code(self.encode(color, depth), T_world_camera, time)

    def observe_code(self, code: FernCode, T_world_camera: ArrayLike, time: int = 0) -> bool:
        """``observe`` for a frame already encoded; return whether it was kept."""
        pose = check_pose(T_world_camera, "T_world_camera")
        if self._count and self.dissimilarities(code).min() <= self.config.keyframe_dissimilarity:
            return False
        self._append(code, pose, time)
        return True

    def _append(self, code: FernCode, pose: Float64, time: int) -> None:
        if self._count == len(self._bits):
            for name in _ROWS:  # double the capacity
                setattr(self, name, _with_more_rows(getattr(self, name)))
        row = self._count
        self._bits[row], self._known[row] = code.bits, code.known
        self._poses[row], self._times[row] = pose, time
        self._count += 1

    def candidates(
        self, color: UInt8, depth: NDArray[np.float32], count: int, before: int | None = None
    ) -> list[Candidate]:
        """Find the most similar keyframes, best first.

        Args:
            color: (H, W, 3) uint8.
            depth: (H, W) metres; 0 = no reading.
            count: largest number to return.
            before: only keyframes observed before this time; all if None.
        """
        return self.candidates_of(self.encode(color, depth), count, before)

    def candidates_of(
        self, code: FernCode, count: int, before: int | None = None
    ) -> list[Candidate]:
        """``candidates`` for a frame already encoded."""
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

    @staticmethod
    def observe_codes(
        databases: Sequence[FernDatabase], codes: FernCode, poses: Float64, times: Int32
    ) -> Bool:
        """``observe_code`` for a frame of each of N databases, compared at once.

        ``codes`` are (N, F), ``poses`` (N, 4, 4), ``times`` (N,). Returns which were kept (N,).
        """
        kept = np.zeros(len(databases), dtype=bool)
        for first in range(0, len(databases), _COMPARED):
            group = databases[first : first + _COMPARED]
            counts = np.array([len(database) for database in group])
            which = np.repeat(np.arange(len(group)), counts)
            bits, known = (
                np.concatenate([getattr(one, name)[: len(one)] for one in group])
                for name in ("_bits", "_known")
            )
            own = slice(first, first + len(group))
            code = FernCode(codes.bits[own][which], codes.known[own][which])
            is_similar = (
                dissimilarities(code, bits, known) <= group[0].config.keyframe_dissimilarity
            )
            kept[own] = np.bincount(which, is_similar, len(group)) == 0
        for k in np.flatnonzero(kept).tolist():
            code = FernCode(codes.bits[k], codes.known[k])
            databases[k]._append(code, check_pose(poses[k], "poses"), int(times[k]))
        return kept

    def move(self, poses: ArrayLike) -> None:
        """Move all keyframes to new poses (K, 4, 4), after a loop closure has deformed the map."""
        stack = np.asarray(poses, dtype=np.float64)
        if stack.shape != (self._count, 4, 4):
            raise InputError(f"poses must have shape {(self._count, 4, 4)}, got {stack.shape}")
        for pose in stack:
            check_pose(pose, "poses")
        self._poses[: self._count] = stack

    def get_state(self) -> dict[str, Any]:
        """The keyframes."""
        return {name[1:]: getattr(self, name)[: self._count].copy() for name in _ROWS}

    def state_like(self) -> Any:
        """See ``Stateful``."""
        return {
            name: ArrayOf(rows.dtype, ("ferns", *rows.shape[1:]), 0 if name == "times" else None)
            for name, rows in self.get_state().items()
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the state of a database with the same camera, configuration and seed."""
        self._count = len(state["bits"])
        for name in _ROWS:
            setattr(self, name, state[name[1:]].copy())


def _with_more_rows(array: NDArray[Any]) -> NDArray[Any]:
    """``array`` (N, ...) followed by at least as many rows of zeros."""
    more = max(_FIRST_ROWS, len(array))
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)])
