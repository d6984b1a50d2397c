"""Which readings of the live frames belong to things that move, by geometry alone.

A reading in space that an earlier frame saw to be free has come there: the free-space violation of
ReFusion (Palazzolo et al., IROS 2019), tested against a few earlier depth images instead of a
volume. What comes into view from behind something else is not taken for moving, as it would be by
its distance from the map's view. A point of an earlier frame that the live frame looks through has
gone away. Both are evidence on the pieces into which depth and normals cut the image (StaticFusion,
Scona et al., ICRA 2018, clusters likewise), kept as log-odds of each pixel and carried from frame
to frame.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert
from ms_slam_env.slam.slam_backend import Float64
from ms_slam_env.slam.surfel.device import HostDeviceBuffer, KernelLaunchCache
from ms_slam_env.slam.surfel.image_pieces import Pieces
from ms_slam_env.slam.surfel.motion_evidence import (
    APPEARED,
    KNOWN,
    OLD,
    PAST,
    RECENT,
    SUPPORTED,
    UNUSED,
    VANISHED,
    carry_log_odds,
    enlarge,
    find_appeared,
    find_vanished,
    hide,
    make_grid,
    sample_depth,
)
from ms_slam_env.slam.surfel.motion_mask import Bool, Float32, MotionMask
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

INTERVAL = 4  # frames between two that are remembered
NEW = 3  # of the earlier frames; slow things have hardly moved since
COLUMNS = 80  # of the grid of pixels that are looked at, about
SIGMAS = 3.0  # of the depth noise
STEP_PER_M = 0.016  # of inverse depth per column of a 160-column image: there pieces are cut
COS_CREASE = 0.8  # of the angle between neighbouring normals, likewise
FEWEST = 12  # pixels of the grid that prove a piece to be moving
SHARE_APPEARED, SHARE_VANISHED = 0.3, 0.6  # of a piece's pixels for and against
NEIGHBOURS = 0.3  # share of the pixels around that must have appeared too
FIRST = NEW * INTERVAL + 1  # frames that have no old ones
NEAR = 0.8  # of the median depth
NEAREST = 0.3  # metres; what is nearer weighs no more
WEIGHT_NEW = 0.2  # of what is new that can lead a pose astray, share of all
SHARE_NEW = 0.7  # of the pixels of a piece that is taken for new
SHARE_KNOWN = 0.1  # of its pixels that an earlier frame saw
FOR, AGAINST, FORGETTING = 2.0, 0.7, 0.15  # log-odds of an observation
MOST, LEAST = 4.0, -2.0  # log-odds at which they end
CONFIRMED = 1.2  # log-odds of what has drawn a pose along: seen to move or forgotten soon
MASKED = 0.5  # log-odds above which a pixel is masked
CHANGED = 0.01  # share of the pixels whose new mask makes an alignment worth repeating
_RIM = np.ones((3, 3), dtype=np.uint8)


class GeometricMotionMask(MotionMask):
    """Compares the live frames with earlier ones."""

    can_doubt = True

    saved = (
        *("_past_depth", "_past_nearest", "_past_poses", "_count"),
        *("_odds", "_depth_before", "_pose_before", "_moved", "_alert"),
    )

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str
    ) -> None:
        self._sigma = SIGMAS * config.depth_noise_m
        super().__init__(batch, intrinsics, device)

    def resize(self, intrinsics: Intrinsics) -> None:
        """See the base class."""
        self._grid = grid = make_grid(intrinsics, COLUMNS, self._sigma)
        self._largest_step = STEP_PER_M * grid.stride * 160 / intrinsics.width
        batch, device = self._batch, self._device
        shape = (grid.height, grid.width)

        def images(dtype: type, *more: int) -> HostDeviceBuffer:
            return HostDeviceBuffer((batch, *more, *shape), dtype, device)

        self._depth, self._nearest = images(wp.float32), images(wp.float32)
        self._found, self._masked = images(wp.int32), images(wp.int32)
        self._past_depth, self._past_nearest = images(wp.float32, PAST), images(wp.float32, PAST)
        self._depth_before, self._odds = images(wp.float32), images(wp.float32)
        self._carried = images(wp.float32)
        self._to_past, self._from_past = (
            HostDeviceBuffer((batch, PAST), wp.mat44, device) for _ in range(2)
        )
        self._to_before, self._from_model = (
            HostDeviceBuffer(batch, wp.mat44, device) for _ in range(2)
        )
        self._age = HostDeviceBuffer((batch, PAST), wp.int32, device)
        self._launches = KernelLaunchCache(device)
        self._past_poses = np.tile(np.eye(4), (batch, PAST, 1, 1))
        self._pose_before = np.tile(np.eye(4), (batch, 1, 1))
        self._count: NDArray[np.int32] = np.zeros(
            batch, dtype=np.int32
        )  # frames since the env was forgotten
        # Frames to come in which what is new is not believed.
        self._alert: NDArray[np.int32] = np.full(batch, FIRST, dtype=np.int32)
        self._live_odds = np.zeros((batch, *shape), dtype=np.float32)
        self._live_pose = self._pose_before
        self._weight_of_new = np.zeros(batch)
        self._new = np.zeros((batch, *shape), dtype=bool)  # what the last strict look found
        self._moved: Bool = np.zeros(batch, dtype=bool)  # whether anything did in the last frames
        self._moves_now: Bool = np.zeros(batch, dtype=bool)  # and does in the live ones
        self._is_marked = True  # whether ``LiveFrame.moving`` may hold a mask
        self._seen: LiveFrame | None = None  # whose launches are recorded
        self._looked: Float64 | None = None  # what the mask at hand was found with

    def forget(self, env: int) -> None:
        """See the base class."""
        self._count[env], self._alert[env] = 0, FIRST

    def expect(self, live: LiveFrame, T_world_live: Float64, is_known: Bool) -> None:
        """See the base class."""
        if self._seen is not live:
            self._launches.clear()
        self._seen = self._live = live
        self._launches.launch("sample", sample_depth, self._sampling)
        self._looked = None
        self._pieces: dict[int, Pieces] = {}
        self._prior = self._carry(T_world_live, is_known & (self._count > 0))
        self._mask_by(self._prior, T_world_live)

    def _carry(self, T_world_live: Float64, is_known: Bool) -> Float32:
        """Log-odds (B, h, w) of the last frames at the new ones; 0 where nothing moved."""
        if not self._moved[is_known].any():
            return np.zeros_like(self._live_odds)
        self._to_before.write(invert(self._pose_before) @ T_world_live)
        self._launches.launch("carry", carry_log_odds, self._carrying)
        odds = self._carried.read()
        odds[~(is_known & self._moved)] = 0.0
        for env in map(int, np.flatnonzero((odds > MASKED).any(axis=(1, 2)))):
            odds[env] = self._pieces_of(env).filled(odds[env], MASKED)
        return odds

    def _pieces_of(self, env: int) -> Pieces:
        """Pieces of the live frame of an env, cut when they are first asked for."""
        if env not in self._pieces:
            stride = self._grid.stride
            normals = self._live.normals[env].numpy()[::stride, ::stride]
            depth = self._depth.read()[env]
            self._pieces[env] = Pieces(depth, normals, self._largest_step, COS_CREASE)
        return self._pieces[env]

    def find(self, T_world_live: Float64, is_known: Bool, strict: bool = False) -> Bool:
        """See the base class."""
        looked = np.concatenate([T_world_live.ravel(), is_known, [strict]])
        if self._looked is not None and np.array_equal(looked, self._looked):
            return np.zeros(self._batch, dtype=bool)
        self._looked = looked
        before = self._masked.read() > 0
        odds = self._prior.copy()
        found = self._compare(T_world_live)
        for env in map(int, np.flatnonzero(is_known)):
            is_still = (found[env] & SUPPORTED) > 0
            self._weight_of_new[env] = self._weight_unseen(env, is_still)
            change = np.where(is_still, -AGAINST, -FORGETTING)
            change[self._moves(env, found[env])] = FOR
            odds[env] = np.clip(odds[env] + change, LEAST, MOST)
            if strict:
                is_old = self._count[env] >= FIRST
                is_new = self._is_new(env, is_still) if is_old else self._is_near(env)
                odds[env][is_new], self._new[env] = MOST, is_new
        self._mask_by(odds, T_world_live)
        return ((odds > MASKED) & ~before).mean(axis=(1, 2)) > CHANGED

    def _moves(self, env: int, found: NDArray[np.int32]) -> Bool:
        """Where (h, w) the evidence of a frame says that something moves.

        A piece moves as a whole if enough of what is known of it says so; besides, what has
        appeared moves wherever several neighbours have.
        """
        appeared = (found & APPEARED) > 0
        appeared &= cv2.blur(appeared.astype(np.float32), (3, 3)) > NEIGHBOURS
        vanished = (found & VANISHED) > 0
        if max(appeared.sum(), vanished.sum()) < FEWEST:
            return np.zeros(found.shape, dtype=bool)
        pieces, against = self._pieces_of(env), (found & SUPPORTED) > 0
        least = np.maximum(FEWEST - 1, SHARE_KNOWN * pieces.number((found & KNOWN) > 0))
        moves = pieces.where(appeared, against, SHARE_APPEARED, least)
        return moves | pieces.where(vanished, against, SHARE_VANISHED, least) | appeared

    def _is_new(self, env: int, is_still: Bool) -> Bool:
        """Pieces (h, w) of which hardly a pixel was there in an old frame."""
        pieces = self._pieces_of(env)
        least = np.full(pieces.count, FEWEST - 1.0)
        return pieces.where(~is_still, is_still, SHARE_NEW, least)

    def doubts(self) -> Bool:
        """See the base class."""
        is_due = (self._weight_of_new > WEIGHT_NEW) & (self._count % INTERVAL == 0)
        return np.asarray((self._alert > 0) | is_due)

    def _weight_unseen(self, env: int, is_still: Bool) -> float:
        """Share of the unmasked readings that are not ``is_still`` (h, w), as alignments weigh."""
        depth = self._depth.read()[env]
        counts = (depth > 0) & (self._masked.read()[env] == 0)
        weights = np.maximum(depth[counts], NEAREST) ** -4.0
        return float(weights[~is_still[counts]].sum() / max(weights.sum(), 1e-6))

    def _is_near(self, env: int) -> Bool:
        """Where (h, w) something is clearly nearer than half of the image, with a rim."""
        depth = self._depth.read()[env]
        if not depth.any():
            return depth > 0
        is_near = (depth > 0) & (depth < NEAR * np.median(depth[depth > 0]))
        opened = cv2.morphologyEx(is_near.astype(np.uint8), cv2.MORPH_OPEN, _RIM)
        return np.asarray(cv2.dilate(opened, _RIM) > 0)

    def confirm(self, where: Bool) -> None:
        """See the base class."""
        at_least = np.where(self._new[where], CONFIRMED, 0.0)
        self._prior[where] = np.maximum(self._prior[where], at_least)
        self._alert[where] = np.maximum(self._alert[where], INTERVAL)

    def _compare(self, T_world_live: Float64) -> NDArray[np.int32]:
        """Evidence (B, h, w) of the live frames, taken at poses (B, 4, 4)."""
        to_past = invert(self._past_poses) @ T_world_live[:, None]
        self._to_past.write(to_past)
        self._from_past.write(invert(to_past))
        self._age.write(self._ages())
        self._launches.launch("appeared", find_appeared, self._appearing)
        self._launches.launch("vanished", find_vanished, self._vanishing)
        return self._found.read()

    # Threads and arguments of the kernels, as ``KernelLaunchCache`` records them.

    @property
    def _rows(self) -> tuple[int, int]:
        return self._batch, self._grid.height

    def _sampling(self) -> tuple[tuple[int, ...], list[Any]]:
        live = [self._live.depth.flatten(), self._live.raw_depth.flatten()]
        return self._rows, [*live, self._grid, *_flat(self._depth, self._nearest)]

    def _carrying(self) -> tuple[tuple[int, ...], list[Any]]:
        images = _flat(self._depth, self._depth_before, self._odds)
        return self._rows, [*images, self._to_before.array, self._grid, *_flat(self._carried)]

    def _appearing(self) -> tuple[tuple[int, ...], list[Any]]:
        images = _flat(self._depth, self._past_nearest, self._past_depth)
        poses = [self._to_past.array, self._age.array]
        return self._rows, [*images, *poses, self._grid, *_flat(self._found)]

    def _vanishing(self) -> tuple[tuple[int, ...], list[Any]]:
        images, batch = _flat(self._nearest, self._past_depth, self._masked), self._batch
        poses = [self._from_past.array, self._age.array]
        threads = (batch, PAST, self._grid.height)
        return threads, [*images, *poses, self._grid, *_flat(self._found)]

    def _enlarging(self) -> tuple[tuple[int, ...], list[Any]]:
        rows = (self._batch, self._grid.live_height)
        return rows, [*_flat(self._masked), self._grid, self._live.moving.flatten()]

    def _ages(self) -> NDArray[np.int32]:
        """``UNUSED``, ``RECENT`` or ``OLD`` for each (B, PAST) of the earlier frames."""
        stored = -(-self._count[:, None] // INTERVAL)
        slots = np.arange(PAST)
        back = (stored - 1 - slots) % PAST  # how many are newer
        return np.where(slots < stored, np.where(back < NEW, RECENT, OLD), UNUSED)

    def _mask_by(self, odds: Float32, T_world_live: Float64) -> None:
        """Mask the live frames at poses (B, 4, 4) by log-odds (B, h, w), with a rim of a pixel."""
        self._live_odds, self._live_pose = odds, T_world_live
        is_masked = odds > MASKED
        self._moves_now = np.asarray(is_masked.any(axis=(1, 2)))
        if self._moves_now.any():
            is_masked = np.array([cv2.dilate(each.astype(np.uint8), _RIM) for each in is_masked])
        self._masked.write(is_masked)

    def hide(self, view: ModelView, T_world_model: Float64) -> bool:
        """See the base class."""
        if not self._moves_now.any():
            return False
        self._from_model.write(invert(self._live_pose) @ T_world_model)
        images = [
            image.reshape((self._batch, -1))
            for image in (view.vertices, view.normals, view.intensity)
        ]
        inputs = [self._from_model.array, *_flat(self._masked), self._grid, *images]
        wp.launch(hide, images[0].shape, inputs, device=self._device)
        return True

    def remember(self, live: LiveFrame, T_world_live: Float64, good: Bool) -> None:
        """See the base class."""
        if self._is_marked or self._moves_now.any():
            self._launches.launch("enlarge", enlarge, self._enlarging)
        self._is_marked = bool(self._moves_now.any())
        is_due: Bool = self._count % INTERVAL == 0
        due: Bool = good & is_due
        if due.any():
            slots = self._count // INTERVAL % PAST
            self._past_poses[due, slots[due]] = T_world_live[due]
            depth = self._depth.read()
            depth[self._masked.read() > 0] *= -1.0  # of what moves
            _store(self._past_depth, due, slots, depth)
            _store(self._past_nearest, due, slots, self._nearest.read())
        self._pose_before[good] = T_world_live[good]
        self._moved[good] = self._moves_now[good]
        if self._moved.any():
            odds, depths = self._odds.read(), self._depth_before.read()
            odds[good], depths[good] = self._live_odds[good], self._depth.read()[good]
            self._odds.write(odds)
            self._depth_before.write(depths)
        self._count[good] += 1
        self._alert[good] = np.maximum(self._alert[good] - 1, 0)

    def share(self) -> Float64:
        """See the base class."""
        is_read = self._depth.read() > 0
        masked = (self._live_odds > MASKED) & is_read
        return np.asarray(masked.sum(axis=(1, 2)) / np.maximum(is_read.sum(axis=(1, 2)), 1))

    def mask(self, env: int) -> Bool | None:
        """See the base class."""
        return self._masked.read()[env] > 0


def _flat(*buffers: HostDeviceBuffer) -> list[wp.array]:
    return [buffer.array.flatten() for buffer in buffers]


def _store(past: HostDeviceBuffer, due: Bool, slots: NDArray[Any], live: Float32) -> None:
    """Put the images of the envs that are due into their slots."""
    images = past.read()
    images[due, slots[due]] = live[due]
    past.write(images)


def make_motion_mask(
    batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str
) -> MotionMask:
    """The motion mask ``config.motion_mask`` for B envs with one camera model."""
    if config.motion_mask == "none":
        return MotionMask(batch, intrinsics, device)
    return GeometricMotionMask(batch, intrinsics, config, device)
