"""What moves in a rendered sequence, and how well a motion mask tells it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ms_slam_env._runtime.arrays import Bool
from ms_slam_env.sequences.rendering import RenderedFrames
from ms_slam_env.slam.base import TrackResult


def true_masks(frames: RenderedFrames) -> Bool:
    """Where (N, H, W) a moving object is in each frame, also while it stands still."""
    movers = tuple(frames.object_trajectories)
    moving = [
        index
        for index, label in enumerate(frames.labels)
        if any(label == name or label.startswith(f"{name} ") for name in movers)
    ]
    return np.array([np.isin(frames.truth(k).labels, moving) for k in range(len(frames))])


def found_masks(results: Sequence[TrackResult], shape: tuple[int, int]) -> Bool | None:
    """The masks (N, H, W) that SLAM found; None if it looks for none, empty where it was lost."""
    known = [result.moving for result in results if result.moving is not None]
    if not known:
        return None
    nothing = np.zeros_like(known[0])
    step = -(-shape[0] // nothing.shape[0])
    rows, columns = (
        np.minimum((np.arange(size) + step // 2) // step, small - 1)
        for size, small in zip(shape, nothing.shape, strict=True)
    )
    masks = [nothing if result.moving is None else result.moving for result in results]
    return np.array(masks)[:, rows][:, :, columns]


def mask_measures(found: Bool, true: Bool, is_read: Bool) -> dict[str, float | None]:
    """Precision, recall, overlap and false share of masks (N, H, W), of the pixels with depth.

    None where nothing is there to be found.
    """
    found, true = found & is_read, true & is_read
    both, either = int((found & true).sum()), int((found | true).sum())
    moves = true.any()
    return {
        "mask_precision": both / int(found.sum()) if moves and found.any() else None,
        "mask_recall": both / int(true.sum()) if moves else None,
        "mask_iou": both / either if moves else None,
        "mask_false_share": int((found & ~true).sum()) / max(int(is_read.sum()), 1),
        "moving_share": int(true.sum()) / max(int(is_read.sum()), 1),
    }
