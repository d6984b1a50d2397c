"""Blocks of successive surfels with their bounding boxes, so that a frame need not look at all.

New surfels are appended frame by frame, so those of a block were made close together. A camera
tests the box of a block first: the cost of listing what is in view follows what is near the view,
not what is stored. Boxes of the blocks in view are taken anew after every fusion, which alone moves
surfels a little; other boxes stay as they are. The same holds for the time when a block's first
unstable surfel is due for removal.
"""

# mypy: disable-error-code="empty-body"

from __future__ import annotations

from ms_slam_env._warp import wp
from ms_slam_env.slam.surfel.discs import SplatCamera
from ms_slam_env.slam.surfel.surfel_arrays import Surfels, rotation_of, translation_of

BLOCK = 128
"""Surfels of a block."""

_BLOCK = wp.constant(BLOCK)


@wp.struct
class Blocks:
    """Blocks of B maps: arrays (B, capacity / BLOCK, rounded up).

    Attributes:
        low: lower corner of the bounding box, world frame.
        high: upper corner.
        expiry: frame that saw the block's longest unseen unstable surfel; the largest number if all
            are stable or dead.
        listed: blocks that a camera may see.
        num_listed: (B,) how many those are.
        bounded: (B,) slots whose blocks have a box that holds.
    """

    low: wp.array2d(dtype=wp.vec3)
    high: wp.array2d(dtype=wp.vec3)
    expiry: wp.array2d(dtype=wp.int32)
    listed: wp.array2d(dtype=wp.int32)
    num_listed: wp.array(dtype=wp.int32)
    bounded: wp.array(dtype=wp.int32)


def allocate_blocks(batch: int, capacity: int, device: str) -> Blocks:
    """Blocks of empty maps."""
    blocks = Blocks()
    shape = (batch, -(-capacity // BLOCK))
    blocks.low = wp.zeros(shape, dtype=wp.vec3, device=device)
    blocks.high = wp.zeros(shape, dtype=wp.vec3, device=device)
    blocks.expiry = wp.zeros(shape, dtype=wp.int32, device=device)
    blocks.listed = wp.zeros(shape, dtype=wp.int32, device=device)
    blocks.num_listed = wp.zeros(batch, dtype=wp.int32, device=device)
    blocks.bounded = wp.zeros(batch, dtype=wp.int32, device=device)
    return blocks


@wp.func
def num_blocks(count: int):
    """Blocks that ``count`` slots fill or begin."""
    return (count + _BLOCK - 1) / _BLOCK


@wp.struct
class Frustum:
    """What a camera sees, in its own frame: x between ``low_u`` z and ``high_u`` z, y likewise."""

    R: wp.mat33
    t: wp.vec3
    low_u: float
    high_u: float
    low_v: float
    high_v: float
    z_near: float
    z_far: float


@wp.func
def frustum_of(T_world_camera: wp.mat44, camera: SplatCamera, margin_px: float):
    """Frustum of a camera's image with a margin around."""
    frustum = Frustum()
    frustum.R = wp.transpose(rotation_of(T_world_camera))
    frustum.t = -(frustum.R * translation_of(T_world_camera))
    frustum.low_u = (-0.5 - margin_px - camera.centre[0]) / camera.focal[0]
    frustum.high_u = (float(camera.width) - 0.5 + margin_px - camera.centre[0]) / camera.focal[0]
    frustum.low_v = (-0.5 - margin_px - camera.centre[1]) / camera.focal[1]
    frustum.high_v = (float(camera.height) - 0.5 + margin_px - camera.centre[1]) / camera.focal[1]
    frustum.z_near = camera.z_near
    frustum.z_far = camera.z_far
    return frustum


@wp.func
def reaches_inside(inwards: wp.vec3, distance: float, half: wp.vec3):
    """Whether a box, its centre ``distance`` inside of a plane, is not wholly outside of it.

    ``inwards`` is the plane's normal of any length, ``half`` the box's half size, both in the same
    frame.
    """
    reach = wp.abs(inwards[0]) * half[0] + wp.abs(inwards[1]) * half[1]
    return distance + reach + wp.abs(inwards[2]) * half[2] >= 0.0


@wp.func
def may_see(frustum: Frustum, low: wp.vec3, high: wp.vec3):
    """Whether a point of a box may be inside a frustum; never false if one is."""
    centre = 0.5 * (low + high)
    # Room for rounding, which grows with the coordinates.
    size = wp.abs(centre[0]) + wp.abs(centre[1]) + wp.abs(centre[2])
    room = 1.0e-5 * (1.0 + size)
    half = 0.5 * (high - low) + wp.vec3(room, room, room)
    p = frustum.R * centre + frustum.t
    right = wp.vec3(frustum.R[0, 0], frustum.R[0, 1], frustum.R[0, 2])
    down = wp.vec3(frustum.R[1, 0], frustum.R[1, 1], frustum.R[1, 2])
    forward = wp.vec3(frustum.R[2, 0], frustum.R[2, 1], frustum.R[2, 2])
    return (
        reaches_inside(forward, p[2] - frustum.z_near, half)
        and reaches_inside(forward, frustum.z_far - p[2], half)
        and reaches_inside(right - frustum.low_u * forward, p[0] - frustum.low_u * p[2], half)
        and reaches_inside(frustum.high_u * forward - right, frustum.high_u * p[2] - p[0], half)
        and reaches_inside(down - frustum.low_v * forward, p[1] - frustum.low_v * p[2], half)
        and reaches_inside(frustum.high_v * forward - down, frustum.high_v * p[2] - p[1], half)
    )


@wp.kernel
def list_blocks(
    surfels: Surfels,
    blocks: Blocks,
    first_env: int,
    poses: wp.array(dtype=wp.mat44),
    camera: SplatCamera,
    margin_px: float,
    workers: int,
) -> None:
    """List the blocks with a surfel that the camera may see, for ``cull``.

    ``poses[k]`` is T_world_camera of env ``first_env + k``; its list is the k-th.
    """
    k, worker = wp.tid()
    b = first_env + k
    frustum = frustum_of(poses[k], camera, margin_px)
    count = num_blocks(surfels.count[b])
    block = int(worker)
    while block < count:
        if may_see(frustum, blocks.low[b, block], blocks.high[b, block]):
            blocks.listed[k, wp.atomic_add(blocks.num_listed, k, 1)] = block
        block += workers


@wp.func_native(
    """
const size_t start = size_t(b) * surfels.radius.shape[1] + first;
const float* p = (const float*)surfels.position.data + 3 * start;
const float* confidence = surfels.confidence.data + start;
const int* seen = surfels.seen.data + start;
// Eight surfels' coordinates at a time: 24 is a multiple of 3.
float low[24], high[24];
for (int k = 0; k < 24; ++k) low[k] = high[k] = p[k % 3];
int done = 0;
for (; done + 24 <= 3 * n; done += 24) {
    for (int k = 0; k < 24; ++k) {
        low[k] = p[done + k] < low[k] ? p[done + k] : low[k];
        high[k] = p[done + k] > high[k] ? p[done + k] : high[k];
    }
}
for (int k = 0; done + k < 3 * n; ++k) {
    low[k] = p[done + k] < low[k] ? p[done + k] : low[k];
    high[k] = p[done + k] > high[k] ? p[done + k] : high[k];
}
for (int k = 3; k < 24; ++k) {
    low[k % 3] = low[k] < low[k % 3] ? low[k] : low[k % 3];
    high[k % 3] = high[k] > high[k % 3] ? high[k] : high[k % 3];
}
int expiry = 0x7fffffff;
for (int k = 0; k < n; ++k) {
    const bool is_unstable = (confidence[k] > 0.0f) & (confidence[k] < threshold);
    const int due = is_unstable ? seen[k] : 0x7fffffff;
    expiry = due < expiry ? due : expiry;
}
const size_t block = size_t(b) * blocks.expiry.shape[1] + first / BLOCK_SIZE;
blocks.low.data[block] = wp::vec3(low[0], low[1], low[2]);
blocks.high.data[block] = wp::vec3(high[0], high[1], high[2]);
blocks.expiry.data[block] = expiry;
""".replace("BLOCK_SIZE", str(BLOCK))
)
def bound(surfels: Surfels, blocks: Blocks, b: int, first: int, n: int, threshold: float):
    """Set box and expiry of the block of the ``n`` surfels from ``first`` on."""


@wp.kernel
def bound_blocks(
    surfels: Surfels, blocks: Blocks, capacity: int, threshold: float, workers: int
) -> None:
    """Take anew the boxes of the listed blocks and of all whose slots are not bounded yet.

    A second launch, ``set_bounded``, must follow.
    """
    b, worker = wp.tid()
    count = wp.min(surfels.count[b], capacity)
    fresh = blocks.bounded[b] / _BLOCK
    j = int(worker)
    while j < blocks.num_listed[b]:
        block = blocks.listed[b, j]
        first = block * _BLOCK
        if block < fresh and first < count:
            bound(surfels, blocks, b, first, wp.min(_BLOCK, count - first), threshold)
        j += workers
    block = fresh + worker
    while block < num_blocks(count):
        first = block * _BLOCK
        bound(surfels, blocks, b, first, wp.min(_BLOCK, count - first), threshold)
        block += workers


@wp.kernel
def set_bounded(surfels: Surfels, blocks: Blocks, capacity: int) -> None:
    """Note that all boxes hold."""
    b = wp.tid()
    blocks.bounded[b] = wp.min(surfels.count[b], capacity)
