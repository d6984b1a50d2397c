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

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._warp import wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert
from ms_slam_env.slam.base import Float64
from ms_slam_env.slam.state import Saved
from ms_slam_env.slam.surfel.config import SurfelConfig
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
    Grid,
    carry_log_odds,
    enlarge,
    find_appeared,
    find_vanished,
    hide,
    sample_depth,
)
from ms_slam_env.slam.surfel.preprocessing import LiveFrame
from ms_slam_env.slam.surfel.rendering import ModelView

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]

INTERVAL = 4  # frames between two that are remembered
NEW = 3  # of the earlier frames; slow things have hardly moved since
COLUMNS = 80  # of the grid of pixels that are looked at, about
SIGMAS = 3.0  # of the depth noise
STEP_PER_M = 0.016  # of inverse depth per column of a 160-column image: there pieces are cut
COS_CREASE = 0.8  # of the angle between neighbouring normals, likewise
FEWEST = 12  # pixels of the grid that prove a piece to be moving
SHARE_APPEARED, SHARE_VANISHED = 0.3, 0.6  # of a piece's pixels for and against
NEIGHBOURS = 0.3  # share of the pixels around that must have appeared too
SHARE_KNOWN = 0.1  # of its pixels that an earlier frame saw
FOR, AGAINST, FORGETTING = 2.0, 0.7, 0.15  # log-odds of an observation
LEAST, MOST = 2.0, 4.0  # log-odds at which they end
MASKED = 0.5  # log-odds above which a pixel is masked
CHANGED = 0.01  # share of the pixels whose new mask makes an alignment worth repeating
_RIM = np.ones((3, 3), dtype=np.uint8)


class MotionMask(Saved):
    """Tells which readings of the live frames of B envs belong to things that move.

    This one takes the world to be still.

    Attributes:
        can_doubt: whether it ever finds anything.
    """

    can_doubt = False

    def __init__(self, batch: int, intrinsics: Intrinsics, device: str) -> None:
        self._batch, self._device = batch, device
        self.resize(intrinsics)

    def resize(self, intrinsics: Intrinsics) -> None:
        """Go on with frames of another size; what was seen at the old one is forgotten."""

    def forget(self, env: int) -> None:
        """Forget what one env has seen."""

    def expect(self, live: LiveFrame, T_world_live: Float64, is_known: Bool) -> None:
        """Take what moved in the last frames to new ones at about ``T_world_live`` (B, 4, 4).

        Where that is not known, ``is_known`` (B,), nothing is masked.
        """

    def find(self, T_world_live: Float64, is_known: Bool) -> Bool:
        """Look for what moves in the frames, taken at poses (B, 4, 4).

        Returns:
            (B,) whether so much is new in the mask that the frame should be aligned again.
        """
        return np.zeros(self._batch, dtype=bool)

    def hide(self, view: ModelView, T_world_model: Float64) -> bool:
        """Empty a view of the maps where masked readings lie; whether there are any.

        ``T_world_model`` (B, 4, 4) are the poses of the view.
        """
        return False

    def remember(self, live: LiveFrame, T_world_live: Float64, good: Bool) -> None:
        """Mask ``live``; take it as seen from poses (B, 4, 4), where that is ``good`` (B,)."""

    def mask(self, env: int) -> Bool | None:
        """Every n-th row and column (h, w) of an env's mask; None if nothing is ever masked."""
        return None


class GeometricMotionMask(MotionMask):
    """Compares the live frames with earlier ones."""

    can_doubt = True

    saved = (
        *("_past_depth", "_past_nearest", "_past_poses", "_count"),
        *("_odds", "_depth_before", "_pose_before"),
    )

    def __init__(
        self, batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str
    ) -> None:
        self._sigma = SIGMAS * config.depth_noise_m
        super().__init__(batch, intrinsics, device)

    def resize(self, intrinsics: Intrinsics) -> None:
        """See the base class."""
        self._grid = grid = _grid(intrinsics, self._sigma)
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
        self._count = np.zeros(batch, dtype=np.int32)  # frames since the env was forgotten
        self._live_odds = np.zeros((batch, *shape), dtype=np.float32)
        self._live_pose = self._pose_before

    def forget(self, env: int) -> None:
        """See the base class."""
        self._count[env] = 0

    def expect(self, live: LiveFrame, T_world_live: Float64, is_known: Bool) -> None:
        """See the base class."""
        grid, rows = self._grid, (self._batch, self._grid.height)
        self._live = live
        flat = [live.depth.flatten(), live.raw_depth.flatten()]
        sampled = [self._flat(self._depth), self._flat(self._nearest)]
        self._launches.launch("sample", sample_depth, lambda: (rows, [*flat, grid, *sampled]))
        self._to_before.write(invert(self._pose_before) @ T_world_live)
        before = [self._flat(self._depth_before), self._flat(self._odds), self._to_before.array]
        carried = self._flat(self._carried)
        self._launches.launch(
            "carry", carry_log_odds, lambda: (rows, [sampled[0], *before, grid, carried])
        )
        odds = self._carried.read()
        odds[~is_known | (self._count == 0)] = 0.0
        self._pieces: dict[int, Pieces] = {}
        for env in map(int, np.flatnonzero((odds > MASKED).any(axis=(1, 2)))):
            odds[env] = self._pieces_of(env).filled(odds[env], MASKED)
        self._prior = odds
        self._mask_by(odds, T_world_live)

    def _pieces_of(self, env: int) -> Pieces:
        """Pieces of the live frame of an env, cut when they are first asked for."""
        if env not in self._pieces:
            stride = self._grid.stride
            normals = self._live.normals[env].numpy()[::stride, ::stride]
            depth = self._depth.read()[env]
            self._pieces[env] = Pieces(depth, normals, self._largest_step, COS_CREASE)
        return self._pieces[env]

    def find(self, T_world_live: Float64, is_known: Bool) -> Bool:
        """See the base class."""
        before = self._masked.read() > 0
        odds = self._prior.copy()
        found = self._compare(T_world_live)
        for env in map(int, np.flatnonzero(is_known)):
            is_still = (found[env] & SUPPORTED) > 0
            change = np.where(is_still, -AGAINST, -FORGETTING)
            change[self._moves(env, found[env])] = FOR
            odds[env] = np.clip(odds[env] + change, -LEAST, MOST)
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

    def _compare(self, T_world_live: Float64) -> NDArray[np.int32]:
        """Evidence (B, h, w) of the live frames, taken at poses (B, 4, 4)."""
        grid, rows = self._grid, (self._batch, self._grid.height)
        to_past = invert(self._past_poses) @ T_world_live[:, None]
        self._to_past.write(to_past)
        self._from_past.write(invert(to_past))
        self._age.write(self._ages())
        shared = [self._age.array, grid, self._flat(self._found)]
        live = [self._flat(self._depth), self._flat(self._nearest)]
        past = [self._flat(self._past_nearest), self._flat(self._past_depth)]
        self._launches.launch(
            "appeared",
            find_appeared,
            lambda: (rows, [live[0], *past, self._to_past.array, *shared]),
        )
        self._launches.launch(
            "vanished",
            find_vanished,
            lambda: (
                (rows[0], PAST, rows[1]),
                [live[1], past[1], self._from_past.array, *shared],
            ),
        )
        return self._found.read()

    def _ages(self) -> NDArray[np.int32]:
        """``UNUSED``, ``RECENT`` or ``OLD`` for each (B, PAST) of the earlier frames."""
        stored = -(-self._count[:, None] // INTERVAL)
        slots = np.arange(PAST)
        back = (stored - 1 - slots) % PAST  # how many are newer
        return np.where(slots < stored, np.where(back < NEW, RECENT, OLD), UNUSED)

    def _mask_by(self, odds: Float32, T_world_live: Float64) -> None:
        """Mask the live frames at poses (B, 4, 4) by log-odds (B, h, w), with a rim of a pixel."""
        self._live_odds, self._live_pose = odds, T_world_live
        self._masked.write([cv2.dilate((each > MASKED).astype(np.uint8), _RIM) for each in odds])

    def hide(self, view: ModelView, T_world_model: Float64) -> bool:
        """See the base class."""
        if not (self._live_odds > MASKED).any():
            return False
        self._from_model.write(invert(self._live_pose) @ T_world_model)
        images = [
            image.reshape((self._batch, -1))
            for image in (view.vertices, view.normals, view.intensity)
        ]
        mask = [self._flat(self._masked), self._grid]
        inputs = [self._from_model.array, *mask, *images]
        wp.launch(hide, images[0].shape, inputs, device=self._device)
        return True

    def remember(self, live: LiveFrame, T_world_live: Float64, good: Bool) -> None:
        """See the base class."""
        rows = (self._batch, self._grid.live_height)
        inputs = [self._flat(self._masked), self._grid, live.moving.flatten()]
        self._launches.launch("enlarge", enlarge, lambda: (rows, inputs))
        odds, depths = self._odds.read(), self._depth_before.read()
        past = self._past_depth.read(), self._past_nearest.read()
        depth, nearest = self._depth.read(), self._nearest.read()
        for env in np.flatnonzero(good):
            odds[env], depths[env] = self._live_odds[env], depth[env]
            self._pose_before[env] = T_world_live[env]
            if self._count[env] % INTERVAL == 0:
                slot = self._count[env] // INTERVAL % PAST
                past[0][env, slot], past[1][env, slot] = depth[env], nearest[env]
                self._past_poses[env, slot] = T_world_live[env]
            self._count[env] += 1
        for buffer, values in zip(
            (self._odds, self._depth_before, self._past_depth, self._past_nearest),
            (odds, depths, *past),
            strict=True,
        ):
            buffer.write(values)

    def mask(self, env: int) -> Bool | None:
        """See the base class."""
        return self._masked.read()[env] > 0

    @staticmethod
    def _flat(buffer: HostDeviceBuffer) -> wp.array:
        return buffer.array.flatten()


def make_motion_mask(
    batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str
) -> MotionMask:
    """The motion mask ``config.motion_mask`` for B envs with one camera model."""
    if config.motion_mask == "none":
        return MotionMask(batch, intrinsics, device)
    return GeometricMotionMask(batch, intrinsics, config, device)


def _grid(intrinsics: Intrinsics, sigma: float) -> Grid:
    stride = max(1, round(intrinsics.width / COLUMNS))
    small = intrinsics.every_nth(stride)
    grid = Grid()
    grid.stride, grid.width, grid.height = stride, small.width, small.height
    grid.live_width, grid.live_height = intrinsics.width, intrinsics.height
    grid.focal, grid.centre = wp.vec2(small.fx, small.fy), wp.vec2(small.cx, small.cy)
    grid.sigma = sigma
    return grid
