# ruff: noqa: UP018, RUF046
"""Mask the readings of the live frames that belong to moving things, by geometry alone.

A reading in space that an earlier frame saw free has appeared there: the free-space violation of
ReFusion (Palazzolo et al., IROS 2019), tested against a few earlier depth images instead of a
volume. Surfaces that come into view from behind others are not masked; a test of the distance to
the map's view would mask them. A point of an earlier frame that the live frame looks through has
vanished. Both are evidence about segments of the image, cut by depth and normals (StaticFusion,
Scona et al., ICRA 2018, clusters in a similar way). The evidence is kept as log-odds per pixel and
carried from frame to frame.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float32, Float64
from ms_slam_env._runtime.warp import kernel_wp as wp
from ms_slam_env.camera import Intrinsics
from ms_slam_env.geometry import invert
from ms_slam_env.slam.shared.state import Saved
from ms_slam_env.slam.surfel.device import KernelLaunchCache, SavedBuffer, fetch, put
from ms_slam_env.slam.surfel.preprocessing import LiveFrame, Pieces
from ms_slam_env.slam.surfel.rendering import ModelView
from ms_slam_env.slam.surfel.surfel_config import SurfelConfig

PAST = wp.constant(6)  # earlier frames with which the live one is compared
KNOWN, SUPPORTED, APPEARED, VANISHED = (wp.constant(1 << bit) for bit in range(4))
"""Evidence about a reading: an earlier frame saw its place; an old frame saw it already; its place
was free before; something in front of it has gone."""
UNUSED, RECENT, OLD = (wp.constant(age) for age in range(3))
RECEDED_M = wp.constant(0.6)  # a surface farther behind was uncovered; it did not recede
NEAREST_M = wp.constant(0.03)  # smallest distance that cannot be noise


@wp.struct
class Grid:
    """Every ``stride``-th row and column of the live images of B envs."""

    stride: int
    width: int
    height: int
    live_width: int
    live_height: int
    focal: wp.vec2
    centre: wp.vec2
    sigma: float  # tolerance at 1 m, grows with depth squared


def make_grid(intrinsics: Intrinsics, columns: int, sigma: float) -> Grid:
    """A grid of about ``columns`` columns; ``sigma`` is its tolerance at 1 m."""
    stride = max(1, round(intrinsics.width / columns))
    small = intrinsics.every_nth(stride)
    grid = Grid()
    grid.stride, grid.width, grid.height = stride, small.width, small.height
    grid.live_width, grid.live_height = intrinsics.width, intrinsics.height
    grid.focal, grid.centre = wp.vec2(small.fx, small.fy), wp.vec2(small.cx, small.cy)
    grid.sigma = sigma
    return grid


@wp.func
def tolerance(z: float, grid: Grid) -> float:
    """Depth difference, metres, beyond what noise or an inexact pose explain."""
    return wp.max(grid.sigma * z * z, NEAREST_M)


@wp.func
def place(p: wp.vec3, grid: Grid) -> int:
    """Pixel of the grid where a point of the camera's frame is seen; -1 outside."""
    if p[2] < 0.05:
        return -1
    u = int(grid.focal[0] * p[0] / p[2] + grid.centre[0] + 100.5) - 100
    v = int(grid.focal[1] * p[1] / p[2] + grid.centre[1] + 100.5) - 100
    if u < 0 or v < 0 or u >= grid.width or v >= grid.height:
        return -1
    return v * grid.width + u


@wp.func
def point(u: int, v: int, z: float, grid: Grid) -> wp.vec3:
    """Point of the camera's frame at a pixel of the grid."""
    x = (float(u) - grid.centre[0]) / grid.focal[0]
    y = (float(v) - grid.centre[1]) / grid.focal[1]
    return wp.vec3(z * x, z * y, z)


@wp.func
def times(T: wp.mat44, p: wp.vec3) -> wp.vec3:
    """Point p moved by T."""
    return wp.vec3(
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@wp.kernel
def sample_depth(
    filtered: wp.array[wp.float32],
    raw: wp.array[wp.float32],
    grid: Grid,
    depth: wp.array[wp.float32],
    nearest: wp.array[wp.float32],
) -> None:
    """Sample filtered depth on the grid, and the smallest raw reading around each of its pixels.

    The smallest reading is 0 (unknown) where the pixel itself has no reading.
    """
    b, v = wp.tid()
    image = b * grid.live_height * grid.live_width
    row = (b * grid.height + v) * grid.width
    u = int(0)
    while u < grid.width:
        centre = image + v * grid.stride * grid.live_width + u * grid.stride
        put(depth, row + u, fetch(filtered, centre))
        least = fetch(raw, centre)
        if least > 0.0:
            y = wp.max(v - 1, 0)
            while y <= wp.min(v + 1, grid.height - 1):
                x = wp.max(u - 1, 0)
                while x <= wp.min(u + 1, grid.width - 1):
                    at = image + y * grid.stride * grid.live_width + x * grid.stride
                    near = fetch(raw, at)
                    least = wp.where(near > 0.0, wp.min(near, least), least)
                    x += 1
                y += 1
        put(nearest, row + u, least)
        u += 1


@wp.kernel
def find_appeared(
    depth: wp.array[wp.float32],
    past_nearest: wp.array[wp.float32],
    past_depth: wp.array[wp.float32],
    T_past_live: wp.array2d[wp.mat44],  # (B, PAST)
    age: wp.array2d[wp.int32],  # (B, PAST)
    grid: Grid,
    found: wp.array[wp.int32],
) -> None:
    """Mark readings where an earlier frame saw free space, and those where any frame looked."""
    b, v = wp.tid()
    row = (b * grid.height + v) * grid.width
    pixels = grid.height * grid.width
    u = int(0)
    while u < grid.width:
        result = int(0)
        z = fetch(depth, row + u)
        if z > 0.0:
            p = point(u, v, z, grid)
            for k in range(PAST):
                if age[b, k] != UNUSED and result < APPEARED:
                    q = times(T_past_live[b, k], p)
                    at = place(q, grid)
                    if at >= 0:
                        near = fetch(past_nearest, (b * PAST + k) * pixels + at)
                        if near > 0.0:
                            off = tolerance(q[2], grid)
                            here = wp.abs(fetch(past_depth, (b * PAST + k) * pixels + at) - q[2])
                            result |= wp.where(near > q[2] + off, KNOWN | APPEARED, KNOWN)
                            if age[b, k] == OLD and here < off:
                                result |= SUPPORTED
        put(found, row + u, result)
        u += 1


@wp.kernel
def find_vanished(
    nearest: wp.array[wp.float32],
    past_depth: wp.array[wp.float32],
    masked: wp.array[wp.int32],  # (B * h * w), the present mask of the live frames
    T_live_past: wp.array2d[wp.mat44],  # (B, PAST)
    age: wp.array2d[wp.int32],  # (B, PAST)
    grid: Grid,
    found: wp.array[wp.int32],
) -> None:
    """Mark where the live frame looks through a point of an earlier frame.

    A point already known to move says nothing about the surface that it uncovers, unless that
    surface is masked.
    """
    b, k, v = wp.tid()
    if age[b, k] != OLD:  # only since an old frame has it moved far enough to tell
        return
    pixels = grid.height * grid.width
    row = (b * PAST + k) * pixels + v * grid.width
    u = int(0)
    while u < grid.width:
        moved = fetch(past_depth, row + u) < 0.0
        z = wp.abs(fetch(past_depth, row + u))
        if z > 0.0:
            q = times(T_live_past[b, k], point(u, v, z, grid))
            at = place(q, grid)
            if at >= 0:
                i = b * pixels + at
                behind = fetch(nearest, i) - q[2]
                is_through = behind > tolerance(q[2], grid) and behind < RECEDED_M
                if is_through and (not moved or fetch(masked, i) != 0):
                    put(found, i, fetch(found, i) | VANISHED)
        u += 1


@wp.kernel
def carry_log_odds(
    depth: wp.array[wp.float32],
    last_depth: wp.array[wp.float32],
    last_odds: wp.array[wp.float32],
    T_last_live: wp.array[wp.mat44],
    grid: Grid,
    odds: wp.array[wp.float32],
) -> None:
    """Carry log-odds of the last frame to live readings, from the nearby pixel closest in depth."""
    b, v = wp.tid()
    row = (b * grid.height + v) * grid.width
    pixels = grid.height * grid.width
    u = int(0)
    while u < grid.width:
        value = float(0.0)
        z = fetch(depth, row + u)
        if z > 0.0:
            q = times(T_last_live[b], point(u, v, z, grid))
            at = place(q, grid)
            if at >= 0:
                closest = 0.03 * q[2]
                column = at % grid.width
                line = at / grid.width
                for step in range(9):
                    k = (step + 4) % 9  # the middle first
                    x = column + k % 3 - 1
                    y = line + k / 3 - 1
                    if x >= 0 and y >= 0 and x < grid.width and y < grid.height:
                        i = b * pixels + y * grid.width + x
                        gap = wp.abs(fetch(last_depth, i) - q[2])
                        if gap < closest and (step == 0 or closest == 0.03 * q[2]):
                            closest = gap
                            value = fetch(last_odds, i)
        put(odds, row + u, value)
        u += 1


WEIGHT_ALL, WEIGHT_UNSEEN, NUM_APPEARED, NUM_VANISHED = (wp.constant(i) for i in range(4))
NEIGHBOURS = wp.constant(3)  # of nine, that must have appeared where something moves
NEAREST = wp.constant(0.3)  # metres; what is nearer weighs no more


@wp.func
def mirrored(i: int, size: int) -> int:
    """Row or column next to the border, which is mirrored at the outermost one."""
    inside = wp.abs(i)
    return wp.where(inside < size, inside, 2 * size - 2 - inside)


@wp.kernel
def weigh(
    depth: wp.array3d[wp.float32],  # (B, h, w) of the grid
    masked: wp.array3d[wp.int32],
    found: wp.array3d[wp.int32],
    sums: wp.array3d[wp.float64],  # (B, h, 4) of a row
) -> None:
    """Sum up the evidence of a row: how much readings weigh in alignments, what came and went.

    A reading has appeared if enough of those around have.
    """
    b, v = wp.tid()
    height = depth.shape[1]
    width = depth.shape[2]
    all_weights = wp.float64(0.0)
    unseen = wp.float64(0.0)
    num_appeared = wp.int32(0)
    num_vanished = wp.int32(0)
    for u in range(width):
        z = depth[b, v, u]
        evidence = found[b, v, u]
        if z > 0.0 and masked[b, v, u] == 0:
            near = wp.max(z, NEAREST)
            weight = wp.float64(1.0 / (near * near * near * near))
            all_weights += weight
            if evidence & SUPPORTED == 0:
                unseen += weight
        if evidence & VANISHED != 0:
            num_vanished += 1
        if evidence & APPEARED != 0:
            around = wp.int32(0)
            for k in range(9):
                y = mirrored(v + k / 3 - 1, height)
                x = mirrored(u + k % 3 - 1, width)
                if found[b, y, x] & APPEARED != 0:
                    around += 1
            if around >= NEIGHBOURS:
                num_appeared += 1
    sums[b, v, WEIGHT_ALL] = all_weights
    sums[b, v, WEIGHT_UNSEEN] = unseen
    sums[b, v, NUM_APPEARED] = wp.float64(num_appeared)
    sums[b, v, NUM_VANISHED] = wp.float64(num_vanished)


@wp.kernel
def store(
    slots: wp.array[wp.int32],  # (B,) -1: none
    depth: wp.array2d[wp.float32],  # (B, h * w)
    nearest: wp.array2d[wp.float32],
    masked: wp.array2d[wp.int32],
    past_depth: wp.array3d[wp.float32],  # (B, PAST, h * w)
    past_nearest: wp.array3d[wp.float32],
) -> None:
    """Put the live images into their slots of the earlier ones; depth of what moves below 0."""
    b, i = wp.tid()
    slot = slots[b]
    if slot >= 0:
        z = depth[b, i]
        past_depth[b, slot, i] = z * wp.where(masked[b, i] != 0, -1.0, 1.0)
        past_nearest[b, slot, i] = nearest[b, i]


@wp.kernel
def hide(
    T_live_model: wp.array[wp.mat44],
    masked: wp.array[wp.int32],  # (B * h * w) of the grid
    grid: Grid,
    vertices: wp.array2d[wp.vec3],  # (B, pixels) of the model view
    normals: wp.array2d[wp.vec3],
    intensity: wp.array2d[wp.float32],
) -> None:
    """Empty a view of the map at the pixels that masked readings cover."""
    b, i = wp.tid()
    p = vertices[b, i]
    if p[2] > 0.0:
        at = place(times(T_live_model[b], p), grid)
        if at >= 0 and fetch(masked, b * grid.height * grid.width + at) != 0:
            nothing = wp.vec3(0.0, 0.0, 0.0)
            vertices[b, i] = nothing
            normals[b, i] = nothing
            intensity[b, i] = 0.0


@wp.kernel
def enlarge(masked: wp.array[wp.int32], grid: Grid, image: wp.array[wp.int32]) -> None:
    """Enlarge the mask of the grid to the size of the live images."""
    b, v = wp.tid()
    half = grid.stride / 2
    line = wp.min((v + half) / grid.stride, grid.height - 1)
    row = (b * grid.height + line) * grid.width
    live_row = (b * grid.live_height + v) * grid.live_width
    u = int(0)
    column = int(0)
    while u < grid.live_width:
        next_column = wp.min(grid.stride * (column + 1) - half, grid.live_width)
        next_column = wp.where(column == grid.width - 1, grid.live_width, next_column)
        value = fetch(masked, row + column)
        while u < next_column:
            put(image, live_row + u, value)
            u += 1
        column += 1


@wp.kernel
def leave_out(
    depth: wp.array3d[wp.float32],  # (B, H, W)
    masked: wp.array3d[wp.int32],  # (B, h, w) of the grid
    step: wp.int32,  # pixels of the image for one of the grid
    left: wp.array3d[wp.float32],
) -> None:
    """Depth without the masked readings."""
    b, v, u = wp.tid()
    left[b, v, u] = wp.where(masked[b, v / step, u / step] != 0, 0.0, depth[b, v, u])


class MotionMask(Saved):
    """Masks the readings of the live frames of B envs that belong to moving things.

    This base class assumes a static world and masks nothing.

    Attributes:
        can_doubt: whether ``doubts`` can ever be true.
    """

    can_doubt = False

    def __init__(self, batch: int, intrinsics: Intrinsics, device: str) -> None:
        self._batch, self._device = batch, device
        self.resize(intrinsics)

    def resize(self, intrinsics: Intrinsics) -> None:
        """Continue with frames of another size; forget what was seen at the old one."""

    def forget(self, env: int) -> None:
        """Forget what one env has seen."""

    def expect(self, live: LiveFrame, T_world_live: Float64, is_known: Bool) -> None:
        """Carry the mask of the last frames to new ones at about ``T_world_live`` (B, 4, 4).

        Nothing is masked in envs whose pose is not known, by ``is_known`` (B,).
        """

    def find(self, T_world_live: Float64, is_known: Bool, strict: bool = False) -> Bool:
        """Look for moving things in the frames, taken at poses (B, 4, 4).

        If ``strict``, a surface counts as moving unless an earlier frame, older than the last few,
        has seen it; in the first frames, every near surface counts as moving.

        Returns:
            (B,) whether the mask has changed so much that the frame should be aligned again.
        """
        return np.zeros(self._batch, dtype=bool)

    def doubts(self) -> Bool:
        """Envs (B,) with enough new surface to lead the pose astray, should it be moving."""
        return np.zeros(self._batch, dtype=bool)

    def confirm(self, where: Bool) -> None:
        """Accept the findings of the last ``strict`` look for the envs ``where`` (B,)."""

    def hide(self, view: ModelView, T_world_model: Float64) -> bool:
        """Empty a view of the maps under the masked readings; return whether there are any.

        ``T_world_model`` (B, 4, 4) are the poses of the view.
        """
        return False

    def remember(self, live: LiveFrame, T_world_live: Float64, good: Bool) -> None:
        """Mask ``live``, and keep it for comparison, at poses (B, 4, 4), where ``good`` (B,)."""

    def share(self) -> Float64:
        """Share (B,) of the readings that are masked."""
        return np.zeros(self._batch)

    def mask(self, env: int) -> Bool | None:
        """Every n-th row and column (h, w) of an env's mask; None if nothing is ever masked."""
        return None

    def still(self, depth: Any) -> Any:
        """Depth images (B, H, W), NumPy or on the device, without the readings of what moves."""
        return depth


INTERVAL = 4  # frames between two that are remembered
NEW = 3  # of the earlier frames; slow things have hardly moved since
COLUMNS = 80  # of the grid of pixels that are looked at, about
SIGMAS = 3.0  # of the depth noise
STEP_PER_M = 0.016  # of inverse depth per column of a 160-column image: there pieces are cut
COS_CREASE = 0.8  # of the angle between neighbouring normals, likewise
FEWEST = 12  # pixels of the grid that prove a piece to be moving
SHARE_APPEARED, SHARE_VANISHED = 0.3, 0.6  # of a piece's pixels for and against
FIRST = NEW * INTERVAL + 1  # frames that have no old ones
NEAR = 0.8  # of the median depth
WEIGHT_NEW = 0.2  # of what is new that can lead a pose astray, share of all
SHARE_NEW = 0.7  # of the pixels of a piece that is taken for new
SHARE_KNOWN = 0.1  # of its pixels that an earlier frame saw
FOR, AGAINST, FORGETTING = 2.0, 0.7, 0.15  # log-odds of an observation
MOST, LEAST = 4.0, -2.0  # log-odds at which they end
CONFIRMED = 1.2  # log-odds of what has drawn a pose along: seen to move or forgotten soon
MASKED = 0.5  # log-odds above which a pixel is masked
CHANGED = 0.01  # share of newly masked pixels that makes an alignment worth repeating
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

        def images(dtype: type, *more: int) -> SavedBuffer:
            return SavedBuffer((batch, *more, *shape), dtype, device)

        self._depth, self._nearest = images(wp.float32), images(wp.float32)
        self._found, self._masked = images(wp.int32), images(wp.int32)
        self._past_depth, self._past_nearest = images(wp.float32, PAST), images(wp.float32, PAST)
        self._depth_before, self._odds = images(wp.float32), images(wp.float32)
        self._carried = images(wp.float32)
        self._to_past, self._from_past = (
            SavedBuffer((batch, PAST), wp.mat44, device) for _ in range(2)
        )
        self._to_before, self._from_model = (SavedBuffer(batch, wp.mat44, device) for _ in range(2))
        self._age = SavedBuffer((batch, PAST), wp.int32, device)
        self._launches = KernelLaunchCache(device)
        self._past_poses = np.tile(np.eye(4), (batch, PAST, 1, 1))
        self._pose_before = np.tile(np.eye(4), (batch, 1, 1))
        self._count: NDArray[np.int32] = np.zeros(
            batch, dtype=np.int32
        )  # frames since the env was forgotten
        # Coming frames in which new surfaces are doubted.
        self._alert: NDArray[np.int32] = np.full(batch, FIRST, dtype=np.int32)
        self._sums = SavedBuffer((batch, grid.height, 4), wp.float64, device)
        self._slots = SavedBuffer(batch, wp.int32, device)
        # By env; of all others the log-odds (h, w) are such that nothing moves.
        self._prior: dict[int, Float32] = {}  # as carried from the last frame
        self._live_odds: dict[int, Float32] = {}
        self._masks: dict[int, Bool] = {}  # what is masked (h, w)
        self._new: dict[int, Bool] = {}  # what the last strict look found (h, w)
        self._live_pose = self._pose_before
        self._weight_of_new = np.zeros(batch)
        self._moved: Bool = np.zeros(batch, dtype=bool)  # whether anything did in the last frames
        self._moves_now: Bool = np.zeros(batch, dtype=bool)  # and does in the live ones
        self._is_marked = True  # whether ``LiveFrame.moving`` may hold a mask
        self._seen: LiveFrame | None = None  # the frame whose launches are recorded
        self._looked: Float64 | None = None  # inputs from which the present mask was found

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

    def _carry(self, T_world_live: Float64, is_known: Bool) -> dict[int, Float32]:
        """Log-odds (h, w) of the last frames at the new ones, of the envs where anything moved."""
        moved = is_known & self._moved
        if not moved.any():
            return {}
        self._to_before.write(invert(self._pose_before) @ T_world_live)
        self._launches.launch("carry", carry_log_odds, self._carrying)
        carried = {}
        for env in np.flatnonzero(moved).tolist():
            odds = self._carried.look_row(env).copy()
            if (odds > MASKED).any():
                odds = self._pieces_of(env).filled(odds, MASKED)
            carried[env] = odds
        return carried

    def _depth_of(self, env: int) -> Float32:
        """Depth (h, w) of an env's live frame on the grid."""
        return self._depth.look_row(env)

    def _pieces_of(self, env: int) -> Pieces:
        """Segments of the live frame of an env, cut at the first call."""
        if env not in self._pieces:
            stride = self._grid.stride
            normals = self._live.normals[env].numpy()[::stride, ::stride]
            depth = self._depth_of(env)
            self._pieces[env] = Pieces(depth, normals, self._largest_step, COS_CREASE)
        return self._pieces[env]

    def find(self, T_world_live: Float64, is_known: Bool, strict: bool = False) -> Bool:
        """See the base class."""
        is_changed = np.zeros(self._batch, dtype=bool)
        looked = np.concatenate([T_world_live.ravel(), is_known, [strict]])
        if self._looked is not None and np.array_equal(looked, self._looked):
            return is_changed
        self._looked = looked
        sums = self._compare(T_world_live)
        new = sums[:, WEIGHT_UNSEEN] / np.maximum(sums[:, WEIGHT_ALL], 1e-6)
        self._weight_of_new[is_known] = new[is_known]
        # All others have too little evidence for anything to move: their log-odds stay below 0.
        is_open = sums[:, [NUM_APPEARED, NUM_VANISHED]].max(axis=1) >= FEWEST
        is_open[list(self._prior)] = True
        odds = dict(self._prior)
        for env in np.flatnonzero(is_known & (is_open | strict)).tolist():
            odds[env] = self._odds_after(env, strict)
        before = self._masks
        self._mask_by(odds, T_world_live)
        for env in odds:
            is_new = odds[env] > MASKED
            if env in before:
                is_new &= ~before[env]
            is_changed[env] = is_new.mean() > CHANGED
        return is_changed

    def _odds_after(self, env: int, strict: bool) -> Float32:
        """Log-odds (h, w) after a look at an env's live frame."""
        found = self._found.look_row(env)
        is_still = (found & SUPPORTED) > 0
        change = np.where(is_still, -AGAINST, -FORGETTING)
        change[self._moves(env, found)] = FOR
        prior = self._prior.get(env, np.zeros(found.shape, dtype=np.float32))
        odds = np.clip(prior + change, LEAST, MOST).astype(np.float32)
        if strict:
            is_old = self._count[env] >= FIRST
            is_new = self._is_new(env, is_still) if is_old else self._is_near(env)
            odds[is_new], self._new[env] = MOST, is_new
        return odds

    def _moves(self, env: int, found: NDArray[np.int32]) -> Bool:
        """Pixels (h, w) where the evidence of a frame says that something moves.

        A segment moves as a whole if enough of its known pixels say so. A pixel that has appeared
        also moves if several of its neighbours have appeared.
        """
        appeared = (found & APPEARED) > 0
        around = cv2.boxFilter(appeared.astype(np.float32), -1, (3, 3), normalize=False)
        appeared &= around >= NEIGHBOURS
        vanished = (found & VANISHED) > 0
        if max(appeared.sum(), vanished.sum()) < FEWEST:
            return np.zeros(found.shape, dtype=bool)
        pieces, against = self._pieces_of(env), (found & SUPPORTED) > 0
        least = np.maximum(FEWEST - 1, SHARE_KNOWN * pieces.number((found & KNOWN) > 0))
        moves = pieces.where(appeared, against, SHARE_APPEARED, least)
        return moves | pieces.where(vanished, against, SHARE_VANISHED, least) | appeared

    def _is_new(self, env: int, is_still: Bool) -> Bool:
        """Pixels (h, w) of segments that old frames hardly support."""
        pieces = self._pieces_of(env)
        least = np.full(pieces.count, FEWEST - 1.0)
        return pieces.where(~is_still, is_still, SHARE_NEW, least)

    def doubts(self) -> Bool:
        """See the base class."""
        is_due = (self._weight_of_new > WEIGHT_NEW) & (self._count % INTERVAL == 0)
        return np.asarray((self._alert > 0) | is_due)

    def _is_near(self, env: int) -> Bool:
        """Where (h, w) something is clearly nearer than half of the image, with a rim."""
        depth = self._depth_of(env)
        if not depth.any():
            return depth > 0
        is_near = (depth > 0) & (depth < NEAR * np.median(depth[depth > 0]))
        opened = cv2.morphologyEx(is_near.astype(np.uint8), cv2.MORPH_OPEN, _RIM)
        return np.asarray(cv2.dilate(opened, _RIM) > 0)

    def confirm(self, where: Bool) -> None:
        """See the base class."""
        for env in np.flatnonzero(where).tolist():
            at_least = np.where(self._new[env], np.float32(CONFIRMED), np.float32(0))
            self._prior[env] = np.maximum(self._prior.get(env, np.float32(0)), at_least)
        self._alert[where] = np.maximum(self._alert[where], INTERVAL)

    def _compare(self, T_world_live: Float64) -> Float64:
        """Find the evidence of the live frames, taken at poses (B, 4, 4); sums (B, 4) of it."""
        to_past = invert(self._past_poses) @ T_world_live[:, None]
        self._to_past.write(to_past)
        self._from_past.write(invert(to_past))
        self._age.write(self._ages())
        self._launches.launch("appeared", find_appeared, self._appearing)
        self._launches.launch("vanished", find_vanished, self._vanishing)
        self._launches.launch("weigh", weigh, self._weighing)
        return np.asarray(self._sums.look().sum(axis=1))

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

    def _storing(self) -> tuple[tuple[int, ...], list[Any]]:
        batch, pixels = self._batch, self._grid.height * self._grid.width
        live = [self._depth.array, self._nearest.array, self._masked.array]
        past = [self._past_depth.array, self._past_nearest.array]
        images = [image.reshape((batch, pixels)) for image in live]
        images += [image.reshape((batch, int(PAST), pixels)) for image in past]
        return (batch, pixels), [self._slots.array, *images]

    def _weighing(self) -> tuple[tuple[int, ...], list[Any]]:
        images = [self._depth.array, self._masked.array, self._found.array]
        return self._rows, [*images, self._sums.array]

    def _enlarging(self) -> tuple[tuple[int, ...], list[Any]]:
        rows = (self._batch, self._grid.live_height)
        return rows, [*_flat(self._masked), self._grid, self._live.moving.flatten()]

    def _ages(self) -> NDArray[np.int32]:
        """``UNUSED``, ``RECENT`` or ``OLD`` for each (B, PAST) of the earlier frames."""
        stored = -(-self._count[:, None] // INTERVAL)
        slots = np.arange(PAST)
        back = (stored - 1 - slots) % PAST  # number of newer ones
        return np.where(slots < stored, np.where(back < NEW, RECENT, OLD), UNUSED)

    def _mask_by(self, odds: dict[int, Float32], T_world_live: Float64) -> None:
        """Mask the live frames at poses (B, 4, 4) by log-odds (h, w), with a rim of a pixel."""
        self._live_odds, self._live_pose = odds, T_world_live
        before, self._masks = self._masks, {}
        for env, values in odds.items():
            is_masked = values > MASKED
            if is_masked.any():
                self._masks[env] = np.asarray(cv2.dilate(is_masked.astype(np.uint8), _RIM) > 0)
        for env in {**before, **self._masks}:
            self._masked.write_row(env, self._masks.get(env, 0))
        self._moves_now = np.zeros(self._batch, dtype=bool)
        self._moves_now[list(self._masks)] = True

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
            self._slots.write(np.where(due, slots, -1))
            self._launches.launch("store", store, self._storing)
        self._pose_before[good] = T_world_live[good]
        self._moved[good] = self._moves_now[good]
        for env in np.flatnonzero(good & self._moved).tolist():
            self._odds.write_row(env, self._live_odds[env])
            self._depth_before.write_row(env, self._depth_of(env))
        self._count[good] += 1
        self._alert[good] = np.maximum(self._alert[good] - 1, 0)

    def share(self) -> Float64:
        """See the base class."""
        shares = np.zeros(self._batch)
        for env, odds in self._live_odds.items():
            is_read = self._depth_of(env) > 0
            shares[env] = ((odds > MASKED) & is_read).sum() / max(is_read.sum(), 1)
        return shares

    def mask(self, env: int) -> Bool | None:
        """See the base class."""
        if env in self._masks:
            return self._masks[env].copy()
        return np.zeros((self._grid.height, self._grid.width), dtype=bool)

    def still(self, depth: Any) -> Any:
        """See the base class."""
        if not self._moves_now.any():
            return depth
        if isinstance(depth, wp.array):
            return self._still_on_device(depth)
        left = depth.copy()
        step = -(-depth.shape[1] // self._grid.height)
        for env, masked in self._masks.items():
            whole = masked.repeat(step, axis=0).repeat(step, axis=1)
            left[env][whole[: depth.shape[1], : depth.shape[2]]] = 0
        return left

    def _still_on_device(self, depth: wp.array) -> wp.array:
        """The same of images on the device."""
        batch, height, width = depth.shape
        step = -(-height // self._grid.height)
        left = wp.empty_like(depth)
        inputs = [depth, self._masked.array, step, left]
        wp.launch(leave_out, (batch, height, width), inputs, device=self._device)
        return left


def _flat(*buffers: SavedBuffer) -> list[wp.array]:
    return [buffer.array.flatten() for buffer in buffers]


def make_motion_mask(
    batch: int, intrinsics: Intrinsics, config: SurfelConfig, device: str
) -> MotionMask:
    """The motion mask ``config.motion_mask`` for B envs with one camera model."""
    if config.motion_mask == "none":
        return MotionMask(batch, intrinsics, device)
    return GeometricMotionMask(batch, intrinsics, config, device)
