"""Precision and recall of loop closures.

A loop is right if the pose that it reports, of the camera relative to an old frame, is within a
tolerance of the true one. Loops that should be found are frames that see a view again after having
left it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Bool, Float64, Int32
from ms_slam_env.camera import Intrinsics
from ms_slam_env.evaluation.seen_surface import back_projected
from ms_slam_env.geometry import invert, relative_angle
from ms_slam_env.slam.slam_backend import Loop

WRONG_DEG = 3.0  # a loop with a larger rotation error is wrong

SEEN_AGAIN, OUT_OF_SIGHT = 0.5, 0.1
"""Shares of a view's readings: least to count as seen again, most to count as out of sight."""
AWAY_S, BREAK_S = 3.0, 1.0
"""Least time in seconds that a view must be out of sight; longest break within one revisit."""
_EVERY = 5  # one in this many frames is a view that may be seen again
_GRID = 8  # stride in rows and columns of the readings of a view
_FEWEST = 20  # readings of a view
_DEPTH_SHARE = 0.05  # largest relative difference of depth at which a point counts as shown


def pose_error(a: Float64, b: Float64) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    distance = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return distance, float(np.degrees(relative_angle(a[:3, :3], b[:3, :3])))


def find_revisits(
    depths: NDArray[np.float32],
    intrinsics: Intrinsics,
    poses: Float64,
    times: Float64,
    reach_m: float,
) -> Int32:
    """Number of the revisit that each of N frames belongs to; -1 for none.

    A frame revisits an old view if it shows at least half of that view's true readings at their
    depth, after three seconds or more in which less than a tenth of them was visible. One revisit
    is a run of such frames, with breaks of up to a second.

    Args:
        depths: (N, h, w) true depth of the static scene, metres; 0 where there is none.
        intrinsics: of these images.
        poses: (N, 4, 4) true T_world_camera.
        times: (N,) seconds.
        reach_m: ignore readings beyond this depth.
    """
    found: Bool = np.zeros(len(poses), dtype=bool)
    coarse = intrinsics.every_nth(_GRID)
    for old in range(0, len(poses), _EVERY):
        points = back_projected(depths[old, ::_GRID, ::_GRID], poses[old], coarse, reach_m)
        if len(points) >= _FEWEST:
            shares = _shown(points, depths[old:], intrinsics, poses[old:])
            found[old:] |= _back(shares, times[old:])
    return _runs(found, times)


def _shown(
    points: Float64, depths: NDArray[np.float32], intrinsics: Intrinsics, poses: Float64
) -> Float64:
    """Share of points (M, 3) that each of N frames shows."""
    T = invert(poses)
    seen = np.einsum("nij,mj->nmi", T[:, :3, :3], points) + T[:, None, :3, 3]
    z = seen[..., 2] = np.maximum(seen[..., 2], 1e-3)  # those behind project outside
    pixels = np.rint(intrinsics.project(seen))
    inside: Bool = np.all((pixels >= 0) & (pixels < (intrinsics.width, intrinsics.height)), axis=-1)
    column, row = np.moveaxis(np.where(inside[..., None], pixels, 0).astype(np.int64), -1, 0)
    there = depths[np.arange(len(poses))[:, None], row, column]
    shares: Float64 = (inside & (np.abs(there - z) <= _DEPTH_SHARE * z)).mean(axis=1)
    return shares


def _back(shares: Float64, times: Float64) -> Bool:
    """Frames (N,) that see a view again after losing it; they show ``shares`` (N,) of it."""
    away = shares <= OUT_OF_SIGHT
    last_here = np.maximum.accumulate(np.where(away, 0, np.arange(len(shares))))
    left = away & (times - times[last_here] >= AWAY_S)
    was_left: Bool = np.maximum.accumulate(left)
    return was_left & (shares >= SEEN_AGAIN)


def _runs(found: Bool, times: Float64) -> Int32:
    """Number (N,) of the run that each of the ``found`` (N,) frames is in; -1 for none."""
    numbers = np.full(len(found), -1, dtype=np.int32)
    frames = np.flatnonzero(found)
    numbers[frames] = np.cumsum(np.diff(times[frames], prepend=times[frames[:1]]) > BREAK_S)
    return numbers


def loop_measures(
    loops: Mapping[int, Loop], truth: Float64, revisits: Int32, tolerance_m: float
) -> dict[str, float | int | None]:
    """Precision and recall of loops by frame.

    ``loop_precision`` is the share of the loops that are right: the reported pose is within
    ``tolerance_m`` and 3 degrees of the true one. ``loop_recall`` is the share of the revisiting
    frames at which a right loop has been reported, at that frame or earlier in the same revisit.
    Each is None if there is no loop or no revisiting frame.

    Args:
        loops: reported loops, by frame.
        truth: (N, 4, 4) true T_world_camera.
        revisits: (N,) from ``find_revisits``.
        tolerance_m: largest position error of a right loop, metres.
    """
    right = [frame for frame, loop in loops.items() if _is_right(frame, loop, truth, tolerance_m)]
    recalled = 0
    for number in range(revisits.max(initial=-1) + 1):
        frames = np.flatnonzero(revisits == number)
        first = min((f for f in right if frames[0] <= f <= frames[-1]), default=frames[-1] + 1)
        recalled += int((frames >= first).sum())
    count = int((revisits >= 0).sum())
    return {
        "revisits": int(revisits.max(initial=-1)) + 1,
        "revisiting_frames": count,
        "stated_loops": len(loops),
        "closed_loops": sum(loop.bent for loop in loops.values()),
        "loop_precision": len(right) / len(loops) if loops else None,
        "loop_recall": recalled / count if count else None,
    }


def _is_right(frame: int, loop: Loop, truth: Float64, tolerance_m: float) -> bool:
    motion = invert(truth[loop.reference]) @ truth[frame]
    error_m, error_deg = pose_error(motion, loop.T_reference_camera)
    return error_m <= tolerance_m and error_deg <= WRONG_DEG
