"""The true surface that the frames of a sequence saw, with which maps are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ms_slam_env._runtime.arrays import Float64
from ms_slam_env.camera import Intrinsics
from ms_slam_env.errors import InputError
from ms_slam_env.geometry.point_clouds import voxel_downsample
from ms_slam_env.sequences import CameraPath, Sequence

SURFACE_SPACING_M = 0.01
CUTOFF_M = 5.0
"""Largest depth that counts as seen, also if SLAM uses more; the simulated sensor's range."""

_MOST_VIEWS = 60  # neighbouring frames see the same surface


def seen_surface(sequence: Sequence, cutoff_m: float = CUTOFF_M) -> Float64:
    """Points (M, 3), `SURFACE_SPACING_M` apart, that at most 60 frames saw within ``cutoff_m``.

    They come from the noise-free depth of a rendered sequence or the depth of a recording, placed
    by the true poses, which must be known.

    Raises:
        InputError: no reading at all, or none up to ``cutoff_m``.
    """
    sequence.check_depth()
    picked = np.unique(np.linspace(0, len(sequence) - 1, _MOST_VIEWS).astype(np.int64))
    clouds = [
        back_projected(
            sequence.true_depth(int(k)), sequence.poses[k], sequence.intrinsics, cutoff_m
        )
        for k in picked
    ]
    cloud = np.concatenate(clouds)
    if not len(cloud):
        raise InputError(f"sequence {sequence.name}: no depth reading up to {cutoff_m:g} m")
    return voxel_downsample(cloud, SURFACE_SPACING_M)


def back_projected(
    depth: NDArray[np.float32], T_world_camera: Float64, intrinsics: Intrinsics, cutoff_m: float
) -> Float64:
    """World points (M, 3) of the readings of ``depth`` (H, W), metres, up to ``cutoff_m``."""
    valid = (depth > 0) & (depth <= cutoff_m)
    return (intrinsics.rays()[valid] * depth[valid, None]) @ T_world_camera[
        :3, :3
    ].T + T_world_camera[:3, 3]


@dataclass(frozen=True)
class SequenceWithSurface(Sequence):
    """A sequence in memory, with its ground truth.

    Attributes:
        surface: (M, 3) points of the true surface that the frames saw, about 1 cm apart, world
            frame.
    """

    surface: Float64


def open_with_surface(text: str, image_size: str, path: CameraPath) -> SequenceWithSurface:
    """Open the sequence named ``text`` at ``image_size``; rendered ones follow ``path``.

    Raises:
        InputError: a sequence that cannot be rendered or read, or a recording without truth or
            depth readings.
    """
    from ms_slam_env.sequences import open_sequence

    sequence = open_sequence(text, image_size, path=path, with_truth=True)
    surface = seen_surface(sequence)
    frames = tuple(sequence.frames)
    return SequenceWithSurface(frames, sequence.poses, sequence.intrinsics, sequence.name, surface)
